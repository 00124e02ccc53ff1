"""`sidestep simulate`: walks of agents that know a map."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from sidestep.cli.options import Backup, ConnectivityOption, Discount, Seed, StepCost, connectivity_of
from sidestep.maps.config import SimulationConfig
from sidestep.tabular.reward import Reward


def simulate(
    map_file: Annotated[Path, Argument(help="The map that the agents know.", metavar="MAP.yaml")],
    out: Annotated[Path, Option("--out", help="CSV or Parquet.", metavar="WALKS.csv")],
    walks: Annotated[int, Option(help="The number of walks.")] = SimulationConfig.walks,
    goals: Annotated[int, Option(help="The number of different goals.")] = SimulationConfig.goals,
    beta: Annotated[float | None, Option(help="β; without it, optimal with ties at random.")] = SimulationConfig.beta,
    backup: Backup = SimulationConfig.backup,
    discount: Discount = Reward.discount,
    step_cost: StepCost = Reward.step_cost,
    connectivity: ConnectivityOption = "4",
    seed: Seed = SimulationConfig.seed,
) -> None:
    """Simulate walks on a known map."""
    import numpy as np

    from sidestep._files import write_json
    from sidestep.cli.display import print_lines, working
    from sidestep.io.demonstrations import walks_from_trajectories
    from sidestep.io.maps import read_map
    from sidestep.io.tables import write_table
    from sidestep.io.walks import table_from_walks
    from sidestep.worlds.walks import simulate_walks

    config = SimulationConfig(walks, goals, beta, backup, Reward(discount, step_cost), seed)
    with working("walking"):
        grid = read_map(map_file, connectivity=connectivity_of(connectivity))
        trajectories, states = simulate_walks(grid, config)
        write_table(out, table_from_walks(walks_from_trajectories(trajectories, states, grid)))
    moves = sum(len(trajectory.actions) for trajectory in trajectories)
    files = {"command": "simulate", "map": str(map_file), "walks": str(out)}
    settings = {**asdict(config), "connectivity": grid.connectivity}
    results = {"settings": settings, "moves": moves, "goals": grid.centers(np.array(states)).tolist()}
    write_json(out.with_suffix(".summary.json"), files | results)
    print_lines(f"{walks} walks, {moves} moves, in {out}")
