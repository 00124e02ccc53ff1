"""The paper's experiments: figures 1–4 and the numbers behind them.

Walkers cross small grids optimally, ties broken at random, ten times for every pair of start and goal; then the map is
forgotten and learned from their walks, in four ways:

- `bam`: actions and transitions, fixed-policy gradient by first-order ascent, as in the paper (figure 2),
- `bam_exact`: the same with the exact gradient by L-BFGS,
- `actions_only`: without the transitions' term (figure 3),
- `transitions_only`: ordinary maximum likelihood (figure 4).

The paper's own two maps survive only as pictures that we do not have; see `sidestep.worlds.grids` for those used here.
"""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from sidestep._files import write_json
from sidestep.evaluation.evaluate import evaluate, plan_paths
from sidestep.inference.fit import Fit, fit
from sidestep.inference.optimizers import LBFGS, Adam, Optimizer
from sidestep.inference.priors import Normal
from sidestep.plotting.maps import Panel, figure_environments, figure_learned, save
from sidestep.robots.planners import ModelPlanner
from sidestep.tabular.backups import Behavior, BoltzmannAverage, Gradient
from sidestep.tabular.demonstrations import Demonstrations, gather
from sidestep.tabular.likelihood import ALL_TERMS, Term
from sidestep.tabular.models import ObstacleGrid, true_model
from sidestep.tabular.reward import Reward
from sidestep.tabular.simulation import simulate
from sidestep.tabular.solve import SolveOptions
from sidestep.worlds.grids import WORLDS, World

WALKS_PER_PAIR = 10
BETA = 10.0
REWARD = Reward(discount=0.95)
PRIOR_MEAN, PRIOR_VARIANCE = -2.0, 4.0 / 2  # the paper's penalty is (θ − b)²/a, so a = 4 is twice the variance


class Variant(NamedTuple):
    """One way of learning: which terms of the likelihood, which gradient, which optimiser."""

    title: str
    terms: tuple[Term, ...]
    gradient: Gradient
    optimizer: Optimizer


VARIANTS: Mapping[str, Variant] = {
    "bam": Variant("BAM", ALL_TERMS, "fixed_policy", Adam()),
    "bam_exact": Variant("BAM, exact gradient", ALL_TERMS, "exact", LBFGS()),
    "actions_only": Variant("actions only", ("actions",), "fixed_policy", Adam()),
    "transitions_only": Variant("transitions only", ("transitions",), "exact", LBFGS()),
}
FIGURES = {
    "figure2.png": ("bam", "bam_exact"),
    "figure3.png": ("actions_only",),
    "figure4.png": ("transitions_only",),
}


def reproduce(folder: Path, seed: int = 0, report: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Runs the experiments, writes `figure1.png` to `figure4.png` and `summary.json` to a folder, returns the summary.

    `seed` draws the walkers' choices among optimal actions. `report` is told what is being done.
    """
    worlds = [make() for make in WORLDS.values()]
    save(figure_environments(worlds), folder / "figure1.png")
    summary: dict[str, Any] = {"settings": _settings(seed), "maps": {}}
    panels: dict[str, list[Panel]] = {name: [] for name in VARIANTS}
    for world in worlds:
        demonstrations = _walks(world, seed)
        summary["maps"][world.name] = {}
        for name, variant in VARIANTS.items():
            report(f"{world.name}: {variant.title}")
            found = _learn(world, demonstrations, variant)
            summary["maps"][world.name][name] = _scores(world, demonstrations, found)
            panels[name].append(_panel(world, variant, found))
    for file, names in FIGURES.items():
        save(
            figure_learned([panel for name in names for panel in panels[name]], columns=len(worlds)),
            folder / file,
        )
    write_json(folder / "summary.json", summary)
    return summary


def _walks(world: World, seed: int) -> Demonstrations:
    """The walkers know the map; their demonstrations' tasks do not name it."""
    pairs = [np.array([start for start in world.starts if start != goal]) for goal in world.goals]
    tasks = [REWARD.reach(world.truth.forget(), goal) for goal in world.goals]
    starts = [np.repeat(own, WALKS_PER_PAIR) for own in pairs]
    return gather(simulate(jax.random.key(seed), true_model(world.truth), tasks, starts), tasks)


def _learn(world: World, demonstrations: Demonstrations, variant: Variant) -> Fit[ObstacleGrid]:
    return fit(
        ObstacleGrid(world.truth.forget(), PRIOR_MEAN),
        demonstrations,
        Behavior(BoltzmannAverage(), BETA),
        prior=Normal(PRIOR_MEAN, PRIOR_VARIANCE),
        terms=variant.terms,
        options=SolveOptions(gradient=variant.gradient),
        optimizer=variant.optimizer,
    )


def _scores(world: World, demonstrations: Demonstrations, found: Fit[ObstacleGrid]) -> dict[str, Any]:
    scored = np.ones(world.truth.shape, dtype=bool)
    scores = evaluate(
        _planner(found), np.asarray(found.model.blocked), world.truth, scored, demonstrations.visited_state_goals()
    )
    return {
        **scores.to_dict(),
        "objective": found.final.objective,
        "converged": found.converged,
        "message": found.message,
    }


def _planner(found: Fit[ObstacleGrid]) -> ModelPlanner:
    """The paper's: what people pursue, in the learned dynamics."""
    return ModelPlanner(found.model, partial(REWARD.reach, found.model.blank))


def _panel(world: World, variant: Variant, found: Fit[ObstacleGrid]) -> Panel:
    paths, _ = plan_paths(_planner(found), np.array(world.starts), np.array(world.goals))
    return Panel(
        f"{world.name}: {variant.title}",
        world.truth,
        np.asarray(found.model.blocked),
        world.truth,
        paths,
        world.starts,
        world.goals,
    )


def _settings(seed: int) -> dict[str, Any]:
    return {
        "walks_per_pair": WALKS_PER_PAIR,
        "backup": "boltzmann",
        "beta": BETA,
        "discount": REWARD.discount,
        "prior_mean": PRIOR_MEAN,
        "prior_variance": PRIOR_VARIANCE,
        "seed": seed,
    }
