"""What the choice of representation does: one room, the same walks, three ways to say where walls may be.

Basis functions and a network are fields under a fit by roll-outs; a fine grid of cells goes through the tabular half,
which solves for values exactly: the walks become moves between cells half a metre wide, in eight directions.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow as pa
from jaxtyping import Array, Float, PyTree

from sidestep._files import write_json
from sidestep.continuous.likelihood import FitProgress
from sidestep.continuous.obstacles import Field, ObstacleMotion, network_field, radial_field
from sidestep.experiments.room import (
    BETA,
    CENTRES,
    PRIOR_MEAN,
    PRIOR_VARIANCE,
    SCHEDULE,
    blocked_in,
    demonstrated,
    learned,
    scores,
    tasks_of,
)
from sidestep.inference.fit import fit
from sidestep.inference.priors import Normal, Prior
from sidestep.io.demonstrations import demonstrations_from_walks as on_grid
from sidestep.io.walks import Walks, walks_from_table
from sidestep.plotting.maps import Panel, figure_learned, save
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.worlds.continuous_room import RESOLUTION, SIDE, Room, room

CELL = 0.5
"""The side of the tabular half's cells, in metres."""
Report = Callable[[str], None]


def run(folder: Path, seed: int = 0, report: Report = lambda _: None) -> dict[str, Any]:
    """Runs the experiment, writes `representations.png` and `summary.json` to a folder, and returns the summary.

    The figures of the best representation, by AUC, are also the summary's own.
    """
    started = time.monotonic()
    world = room()
    report("people walk around the wall")
    demonstrations, _ = demonstrated(world, seed)
    ways = {"basis functions": _by_basis_functions, "network": _by_network, "fine grid": _by_grid}
    results, panels = {}, []
    for name, learn in ways.items():
        report(f"learning with {name}")
        began = time.monotonic()
        blocked, parameters, converged, message = learn(world, demonstrations, seed, report)
        results[name] = {
            **scores(blocked, world)._asdict(),
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


class Said(Prior):
    """A prior on what a field says at some places, whatever its parameters mean.

    A prior on a network's weights would leave its logits free, and one that has once said that all is free hears of no
    wall any more: what people do changes by P(blocked) (1 − P(blocked)) with each logit.
    """

    field: Field
    places: Float[Array, "places dimensions"]
    each: Normal

    def log_density(self, parameters: PyTree[Float[Array, "..."]]) -> Float[Array, ""]:
        """That of the logits at the places."""
        return self.each.log_density(jax.vmap(lambda place: self.field.logit(place, parameters))(self.places))


ModelResult = tuple[Float[np.ndarray, "rows columns"], int, bool, str]
"""P(blocked) in small cells, how many parameters there are, whether the fit converged, and why it ended."""


def _by_basis_functions(world: Room, demonstrations: Demonstrations, seed: int, report: Report) -> ModelResult:
    low, high = world.dynamics.low, world.dynamics.high
    field = radial_field(low, high, (CENTRES, CENTRES), PRIOR_MEAN)
    prior = Normal(PRIOR_MEAN, PRIOR_VARIANCE)
    found = learned(world, field, prior, demonstrations, seed, report=_saying(report, "basis functions"))
    return blocked_in(found.dynamics, world), field.parameters.size, found.converged, found.message


def _by_network(world: Room, demonstrations: Demonstrations, seed: int, report: Report) -> ModelResult:
    """The prior is that of the basis functions, on what the network says where their centres are."""
    low, high = world.dynamics.low, world.dynamics.high
    field = network_field(jax.random.key(seed), low, high, logit=PRIOR_MEAN)
    prior = Said(field, radial_field(low, high, (CENTRES, CENTRES)).centres, Normal(PRIOR_MEAN, PRIOR_VARIANCE))
    found = learned(world, field, prior, demonstrations, seed, report=_saying(report, "network"), rate=0.02)
    count = sum(leaf.size for leaf in jax.tree.leaves(field.parameters))
    return blocked_in(found.dynamics, world), count, found.converged, found.message


def _by_grid(world: Room, demonstrations: Demonstrations, seed: int, report: Report) -> ModelResult:
    """People's costs and sharpness are the same a metre; the Boltzmann average is proper however short a move is."""
    del world, seed, report
    count = round(SIDE / CELL)
    grid = Grid(np.full((count, count), -1), resolution=CELL, connectivity=8)
    moves = on_grid(_walks(demonstrations), grid, discount=1.0, step_cost=CELL)
    people = Behavior(BoltzmannAverage(), BETA)
    found = fit(ObstacleGrid(grid, PRIOR_MEAN), moves, people, prior=Normal(PRIOR_MEAN, PRIOR_VARIANCE))
    finer = np.ones((round(CELL / RESOLUTION),) * 2)
    return np.kron(np.asarray(found.model.blocked), finer), grid.size, found.converged, found.message


def _walks(demonstrations: Demonstrations) -> Walks:
    """The walks as a table of positions; the noise of moves can carry them past the room's border, by little."""
    edge = 1e-6
    goals = np.asarray(demonstrations.tasks.goal)  # pyright: ignore[reportAttributeAccessIssue]
    rows = [
        {"walk": walk, "step": step, "x": x, "y": y, "goal_x": goal[0], "goal_y": goal[1]}
        for walk, (places, goal) in enumerate(zip(demonstrations.paths(), goals[tasks_of(demonstrations)], strict=True))
        for step, (x, y) in enumerate(np.clip(places, edge, SIDE - edge))
    ]
    return walks_from_table(pa.Table.from_pylist(rows))


def _saying(report: Report, name: str) -> Callable[[FitProgress, ObstacleMotion], None]:
    def say(progress: FitProgress, _: ObstacleMotion) -> None:
        report(f"learning with {name}, iteration {progress.iteration} of {SCHEDULE.iterations}")

    return say
