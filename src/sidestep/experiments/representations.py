"""Three representations of walls, learned from the same walks in one room.

Basis functions and a network are fields under a fit by rollouts. A fine grid of cells is learned with exact values
instead: the walks become moves between cells half a meter wide, in eight directions.
"""

import time
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

import sidestep as ss
import sidestep.continuous as sc
from sidestep._typing import FloatTree
from sidestep.experiments.output import Notify, Summary, quiet, write_results
from sidestep.experiments.room import RoomConfig, blocked_map, score_map
from sidestep.io.walks import walks_from_table
from sidestep.plotting.maps import Panel, figure_learned
from sidestep.worlds.continuous_room import RESOLUTION, SIDE, room

CELL = 0.5
"""The side of the grid's cells, in meters."""

_SMALL_CELLS = np.ones((round(CELL / RESOLUTION),) * 2)
"""The cells of the room's map in one of the grid's."""


@dataclass(frozen=True)
class RepresentationsConfig(RoomConfig):
    """Settings of the experiment.

    Attributes:
        network_rate: The learning rate of a network's weights.
        grid_optimizer: The optimizer of the grid's cells.
    """

    network_rate: float = 0.02
    grid_optimizer: ss.Optimizer = field(default_factory=ss.LBFGS)


class FunctionSpacePrior(ss.Prior):
    """A prior on the logits of a field at some places, whatever its parameters mean.

    A prior on a network's weights would leave its logits free. A network with all logits low would then hardly learn,
    because the gradient of each logit is proportional to P(blocked) (1 − P(blocked)).

    Attributes:
        field: The field; only its structure counts.
        places: The places where its logits have the prior.
        each: The prior on every logit.
    """

    field: sc.Field
    places: Float[Array, "places dimensions"]
    each: ss.Normal

    def log_density(self, parameters: FloatTree) -> Float[Array, ""]:
        """Return the log-density of the logits at the places.

        Args:
            parameters: The parameters of the field.
        """
        field = eqx.tree_at(lambda field: field.parameters, self.field, parameters)
        return self.each.log_density(jax.vmap(field.logit)(self.places))


def run(folder: Path, seed: int = 0, notify: Notify = quiet, config: RepresentationsConfig | None = None) -> Summary:
    """Run the experiment; write `representations.png` and `summary.json`.

    Args:
        folder: The folder to write to.
        seed: Draws everything random.
        notify: Called with a line of progress.
        config: The experiment's settings.

    Returns:
        The content of `summary.json`. The scores of the best representation, by AUC, are also the summary's own.
    """
    started, config = time.monotonic(), config or RepresentationsConfig()
    world = room(config.lattice_points)
    notify("agents walk around the wall")
    walks, _ = config.demonstrations(world, seed)
    radial, low, high = config.radial_field(world), world.dynamics.low, world.dynamics.high
    network = sc.network_field(jax.random.key(seed), low, high, logit=config.prior_mean)
    on_logits = FunctionSpacePrior(network, radial.centers, config.prior)
    slower = replace(config, schedule=replace(config.schedule, learning_rate=config.network_rate))
    data = walks, world.actions, seed, notify
    methods = {
        "basis functions": partial(config.fit, world.with_field(radial), *data, prior=config.prior),
        "network": partial(slower.fit, world.with_field(network), *data, prior=on_logits),
        "fine grid": partial(_fit_grid, config, walks),
    }
    results, panels = {}, []
    for name, method in methods.items():
        notify(f"learning with {name}")
        began = time.monotonic()
        fit = method(title=f"learning with {name}")
        if isinstance(fit, sc.ContinuousFit):
            parameters, blocked = fit.dynamics.parameters, blocked_map(fit.dynamics, world)
        else:
            parameters, blocked = fit.model.parameters, np.kron(np.asarray(fit.model.blocked), _SMALL_CELLS)
        count = sum(leaf.size for leaf in jax.tree.leaves(parameters))
        fitted = {"parameters": count, "converged": fit.converged, "message": fit.message}
        results[name] = {**score_map(blocked, world), **fitted, "seconds": round(time.monotonic() - began, 1)}
        panels.append(Panel(f"{name} ({results[name]['seconds']:.0f} s)", world.cells, blocked, world.cells))
    best = max(results.values(), key=lambda result: result["auc"])
    entries = {key: best[key] for key in ("auc", "mean_inside", "mean_outside")}
    entries |= {"representations": results, "moves": len(walks)}
    return write_results(folder, "representations", seed, started, figure_learned(panels), entries)


def _fit_grid(config: RepresentationsConfig, walks: ss.Demonstrations, **_: Any) -> ss.Fit:
    """Fit cells with exact values: costs and β a meter are the same, under the Boltzmann average.

    The Boltzmann average has finite values however short a move is.
    """
    count = round(SIDE / CELL)
    grid = ss.Grid(np.full((count, count), -1), resolution=CELL, connectivity=8)
    moves = ss.demonstrations_from_walks(_walks(walks), grid, discount=1.0, step_cost=CELL)
    behavior = ss.Behavior(ss.BoltzmannAverage(), config.beta)
    model = ss.ObstacleGrid(grid, config.prior_mean)
    return ss.fit(model, moves, behavior, prior=config.prior, optimizer=config.grid_optimizer)


def _walks(demonstrations: ss.Demonstrations) -> ss.Walks:
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
