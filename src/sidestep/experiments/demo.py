"""A first look: an office, learned from the walks of agents that know it.

Agents cross the office between a few places. The map is learned from their walks alone, and used to plan to goals that
no walk had.
"""

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

import sidestep as ss
from sidestep._files import write_json
from sidestep.experiments.output import Notify, Summary, quiet
from sidestep.io.demonstrations import walks_from_trajectories
from sidestep.maps.config import SimulationConfig
from sidestep.plotting.maps import Panel, figure_learned, save
from sidestep.worlds.offices import office, places
from sidestep.worlds.walks import simulate_walks


@dataclass(frozen=True)
class DemoConfig:
    """The office of `rows` × `columns` cells, the agents in it, how the map is learned, and how many new goals."""

    rows: int = 14
    columns: int = 24
    agents: SimulationConfig = field(default_factory=lambda: SimulationConfig(walks=400, goals=12))
    learning: ss.MapConfig = field(default_factory=ss.MapConfig)
    new_places: int = 4


def demo(folder: Path, seed: int = 0, notify: Notify = quiet, config: DemoConfig | None = None) -> Summary:
    """Run the demonstration; write `demo.png`, the walks, and three maps: without obstacles, true, learned.

    Args:
        folder: The folder to write to.
        seed: Draws the office, the walks and the new goals.
        notify: Called with a line of text at each stage.
        config: The sizes; by default those of `sidestep demo`.

    Returns:
        The content of `summary.json`.
    """
    config = config or DemoConfig()
    agents = replace(config.agents, seed=seed)
    truth = office(config.rows, config.columns, seed)
    notify("agents cross the office")
    trajectories, goals = simulate_walks(truth, agents)
    walks = walks_from_trajectories(trajectories, goals, truth)
    ss.write_map(folder / "truth.yaml", truth.known.astype(np.float64), truth)
    blank, nothing = truth.forget(), np.ones(truth.shape, bool)
    ss.write_map(folder / "office.yaml", np.full(truth.shape, 0.5), blank, unknown=nothing)
    ss.write_walks(folder / "walks.csv", walks)

    notify("learning the map from their walks")
    learned = ss.learn_map(truth.forget(), walks, config.learning)
    learning = learned.learning
    assert learning is not None

    notify("planning between all pairs of places")
    scores = learned.evaluate(truth)
    elsewhere = places(truth, config.new_places + len(goals), seed + 1)
    new = elsewhere[~np.isin(elsewhere, goals)][: config.new_places]
    paths, _ = ss.plan_paths(learned.robot(), new[:1], new[1:])
    title = "what they say of its walls, and new plans"
    panels = [
        Panel(f"{len(walks)} walks in an office", truth, paths=learning.demonstrations.paths(), goals=goals),
        Panel(title, learned.grid, learned.blocked, truth, paths, new[:1], new[1:], learned.without_evidence),
    ]
    save(figure_learned(panels), folder / "demo.png")
    entries = {"command": "demo", "agents": asdict(agents), "scores": scores.to_dict()}
    learned.save(folder / "learned", **entries)
    summary = {**entries, **learned.summary()}
    write_json(folder / "summary.json", summary)
    return summary
