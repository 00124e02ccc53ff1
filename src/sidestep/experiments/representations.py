"""Three representations of walls, learned from the same walks in one room.

Basis functions and a network are fields under a fit by rollouts. A fine grid of cells is learned with exact values
instead: the walks become moves between cells half a meter wide, in eight directions.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from sidestep._files import write_json
from sidestep._typing import FloatTree
from sidestep.continuous.likelihood import FitProgress
from sidestep.continuous.obstacles import Field, ObstacleMotion, network_field
from sidestep.experiments.room import Report, RoomConfig, blocked_map, fit_field, score_map
from sidestep.inference.fit import fit
from sidestep.inference.optimizers import LBFGS, Optimizer
from sidestep.inference.priors import Normal, Prior
from sidestep.io.demonstrations import demonstrations_from_walks
from sidestep.io.walks import Walks, walks_from_table
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.worlds.continuous_room import RESOLUTION, SIDE, Room, room

CELL = 0.5
"""The side of the grid's cells, in meters."""

LearnedField = tuple[Float[np.ndarray, "rows columns"], int, bool, str]
"""P(blocked) in small cells, the number of parameters, whether the fit converged, and its message."""


@dataclass(frozen=True)
class RepresentationsConfig(RoomConfig):
    """Settings of the experiment.

    Attributes:
        network_rate: the learning rate of a network's weights.
        grid_optimizer: the optimizer of the grid's cells.
    """

    network_rate: float = 0.02
    grid_optimizer: Optimizer = field(default_factory=LBFGS)


class FunctionSpacePrior(Prior):
    """A prior on the logits of a field at some places, whatever its parameters mean.

    A prior on a network's weights would leave its logits free. A network with all logits low would then hardly learn,
    because the gradient of each logit is proportional to P(blocked) (1 − P(blocked)).

    Attributes:
        field: the field; only its structure counts.
        places: where its logits have the prior.
        each: the prior on every logit.
    """

    field: Field
    places: Float[Array, "places dimensions"]
    each: Normal

    def log_density(self, parameters: FloatTree) -> Float[Array, ""]:
        """Return the log-density of the logits at the places."""
        field = eqx.tree_at(lambda field: field.parameters, self.field, parameters)
        return self.each.log_density(jax.vmap(field.logit)(self.places))


def run(
    folder: Path, seed: int = 0, report: Report = lambda _: None, config: RepresentationsConfig | None = None
) -> dict[str, Any]:
    """Run the experiment, and write `representations.png` and `summary.json` to a folder.

    Args:
        folder: the folder to write to.
        seed: draws everything random.
        report: called with a line of progress.
        config: the experiment's settings.

    Returns:
        The summary. The scores of the best representation, by AUC, are also the summary's own.
    """
    from sidestep.plotting.maps import Panel, figure_learned, save

    started, config = time.monotonic(), config or RepresentationsConfig()
    world = room(config.lattice_points)
    report("agents walk around the wall")
    demonstrations, _ = config.demonstrations(world, seed)
    methods = {"basis functions": _fit_basis_functions, "network": _fit_network, "fine grid": _fit_grid}
    results, panels = {}, []
    for name, method in methods.items():
        report(f"learning with {name}")
        began = time.monotonic()
        blocked, parameters, converged, message = method(world, demonstrations, config, seed, report)
        results[name] = {
            **score_map(blocked, world)._asdict(),
            "parameters": parameters,
            "converged": converged,
            "message": message,
            "seconds": round(time.monotonic() - began, 1),
        }
        panels.append(Panel(f"{name} ({results[name]['seconds']:.0f} s)", world.cells, blocked, world.cells))
    best = max(results.values(), key=lambda result: result["auc"])
    summary = {
        "command": "experiment representations",
        "seed": seed,
        **{key: best[key] for key in ("auc", "mean_inside", "mean_outside")},
        "representations": results,
        "moves": len(demonstrations),
        "seconds": round(time.monotonic() - started, 1),
    }
    save(figure_learned(panels), folder / "representations.png")
    write_json(folder / "summary.json", summary)
    return summary


def _fit_basis_functions(
    world: Room, demonstrations: Demonstrations, config: RepresentationsConfig, seed: int, report: Report
) -> LearnedField:
    progress = _reporting(report, "basis functions", config)
    field = config.radial_field(world)
    result = fit_field(world, field, config.prior, demonstrations, config, seed=seed, report=progress)
    return blocked_map(result.dynamics, world), field.parameters.size, result.converged, result.message


def _fit_network(
    world: Room, demonstrations: Demonstrations, config: RepresentationsConfig, seed: int, report: Report
) -> LearnedField:
    """Fit a network under the prior of the basis functions, on its logits at their centers."""
    low, high = world.dynamics.low, world.dynamics.high
    field = network_field(jax.random.key(seed), low, high, logit=config.prior_mean)
    prior = FunctionSpacePrior(field, config.radial_field(world).centers, config.prior)
    config = replace(config, schedule=replace(config.schedule, learning_rate=config.network_rate))
    progress = _reporting(report, "network", config)
    result = fit_field(world, field, prior, demonstrations, config, seed=seed, report=progress)
    count = sum(leaf.size for leaf in jax.tree.leaves(field.parameters))
    return blocked_map(result.dynamics, world), count, result.converged, result.message


def _fit_grid(
    world: Room, demonstrations: Demonstrations, config: RepresentationsConfig, seed: int, report: Report
) -> LearnedField:
    """Fit cells with exact values: costs and β a meter are the same, under the Boltzmann average.

    The Boltzmann average has finite values however short a move is.
    """
    del world, seed, report
    count = round(SIDE / CELL)
    grid = Grid(np.full((count, count), -1), resolution=CELL, connectivity=8)
    moves = demonstrations_from_walks(_walks(demonstrations), grid, discount=1.0, step_cost=CELL)
    behavior = Behavior(BoltzmannAverage(), config.beta)
    model = ObstacleGrid(grid, config.prior_mean)
    result = fit(model, moves, behavior, prior=config.prior, optimizer=config.grid_optimizer)
    finer = np.ones((round(CELL / RESOLUTION),) * 2)
    return np.kron(np.asarray(result.model.blocked), finer), grid.size, result.converged, result.message


def _walks(demonstrations: Demonstrations) -> Walks:
    """Return the walks as a table of positions, clipped to the room, which noise can leave by a little."""
    import pyarrow as pa

    edge = 1e-6
    goals = np.asarray(demonstrations.tasks.goal)[np.asarray(demonstrations.task)[demonstrations.first_moves()]]  # pyright: ignore[reportAttributeAccessIssue]
    rows = [
        {"walk": walk, "step": step, "x": x, "y": y, "goal_x": goal[0], "goal_y": goal[1]}
        for walk, (places, goal) in enumerate(zip(demonstrations.paths(), goals, strict=True))
        for step, (x, y) in enumerate(np.clip(places, edge, SIDE - edge))
    ]
    return walks_from_table(pa.Table.from_pylist(rows))


def _reporting(
    report: Report, name: str, config: RepresentationsConfig
) -> Callable[[FitProgress, ObstacleMotion], None]:
    def progress(progress: FitProgress, _: ObstacleMotion) -> None:
        report(f"learning with {name}, iteration {progress.iteration} of {config.schedule.iterations}")

    return progress
