"""The paper's experiments: figures 1 to 4 and the numbers behind them.

Agents walk optimally on small grids, ties broken at random, ten times between every start and every goal. The map is
then learned from their walks alone by four variants:

- `bam`: actions and transitions, fixed-policy gradient, Adam, as in the paper (figure 2),
- `bam_exact`: the same with the exact gradient and L-BFGS,
- `actions_only`: without the likelihood of transitions (figure 3),
- `transitions_only`: maximum likelihood of transitions (figure 4).

Two maps of the paper exist only as pictures that we do not have; `sidestep.worlds.grids` has the maps used here.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import sidestep as ss
from sidestep._files import write_json
from sidestep.experiments.output import Notify, Summary, quiet
from sidestep.plotting.maps import Panel, figure_environments, figure_learned, save
from sidestep.robots.planners import ModelPlanner
from sidestep.tabular.backups import Gradient
from sidestep.tabular.likelihood import ALL_TERMS, Term
from sidestep.worlds.grids import WORLDS, World


class Variant(NamedTuple):
    """A variant of learning: the terms of the likelihood, the gradient, and the optimizer."""

    title: str
    terms: tuple[Term, ...]
    gradient: Gradient
    optimizer: ss.Optimizer


VARIANTS: Mapping[str, Variant] = {
    "bam": Variant("BAM", ALL_TERMS, "fixed_policy", ss.Adam()),
    "bam_exact": Variant("BAM, exact gradient", ALL_TERMS, "exact", ss.LBFGS()),
    "actions_only": Variant("actions only", ("actions",), "fixed_policy", ss.Adam()),
    "transitions_only": Variant("transitions only", ("transitions",), "exact", ss.LBFGS()),
}
FIGURES = {"figure2.png": ("bam", "bam_exact"), "figure3.png": ("actions_only",), "figure4.png": ("transitions_only",)}


@dataclass(frozen=True)
class ReproduceConfig:
    """The setting of the experiments; the defaults are the paper's.

    Attributes:
        worlds: The maps, names in `sidestep.worlds.grids.WORLDS`.
        walks_per_pair: The number of walks for each pair of a start and a goal.
        beta: The inverse temperature β that learning assumes.
        reward: The reward of agents, of learning, and of planned paths.
        prior_mean: The mean b of each logit.
        prior_variance: The variance of each logit. The paper's penalty is (θ − b)²/a, so a = 4 is twice the variance.
    """

    worlds: tuple[str, ...] = tuple(WORLDS)
    walks_per_pair: int = 10
    beta: float = 10.0
    reward: ss.Reward = field(default_factory=ss.Reward)
    prior_mean: float = -2.0
    prior_variance: float = 4.0 / 2


def reproduce(folder: Path, seed: int = 0, notify: Notify = quiet, config: ReproduceConfig | None = None) -> Summary:
    """Run the experiments; write `figure1.png` to `figure4.png` and `summary.json`.

    Args:
        folder: The folder to write to.
        seed: Draws the agents' choices among optimal actions.
        notify: Called with a line of text at each stage.
        config: The setting; by default the paper's.

    Returns:
        The content of `summary.json`.
    """
    config = config or ReproduceConfig()
    worlds = [WORLDS[name]() for name in config.worlds]
    save(figure_environments(worlds), folder / "figure1.png")
    scores: dict[str, dict[str, Any]] = {world.name: {} for world in worlds}
    panels: dict[str, list[Panel]] = {name: [] for name in VARIANTS}
    for world in worlds:
        demonstrations = simulate_walks(world, config, seed)
        for name, variant in VARIANTS.items():
            title = f"{world.name}: {variant.title}"
            notify(title)
            scores[world.name][name], panel = _learn(world, demonstrations, variant, config, title)
            panels[name].append(panel)
    for file, names in FIGURES.items():
        save(figure_learned([panel for name in names for panel in panels[name]], columns=len(worlds)), folder / file)
    summary = {"settings": {**asdict(config), "worlds": list(config.worlds), "seed": seed}, "maps": scores}
    write_json(folder / "summary.json", summary)
    return summary


def simulate_walks(world: World, config: ReproduceConfig, seed: int) -> ss.Demonstrations:
    """Return walks of optimal agents that know the map; the tasks of the demonstrations do not contain it.

    Args:
        world: The map, the starts and the goals.
        config: The number of walks and the reward.
        seed: Draws the agents' choices among optimal actions.

    Returns:
        The moves of `config.walks_per_pair` walks from each start to each other goal.
    """
    tasks = [config.reward.reach(world.truth.forget(), goal) for goal in world.goals]
    others = ([start for start in world.starts if start != goal] for goal in world.goals)
    starts = [np.repeat(each, config.walks_per_pair) for each in others]
    return ss.gather(ss.simulate(jax.random.key(seed), ss.true_model(world.truth), tasks, starts), tasks)


def _learn(
    world: World, walks: ss.Demonstrations, variant: Variant, config: ReproduceConfig, title: str
) -> tuple[dict[str, Any], Panel]:
    """Return the scores of what a variant learns, and its panel."""
    model = ss.ObstacleGrid(world.truth.forget(), config.prior_mean)
    behavior = ss.Behavior(ss.BoltzmannAverage(), config.beta)
    prior, options = ss.Normal(config.prior_mean, config.prior_variance), ss.SolveOptions(gradient=variant.gradient)
    fit = ss.fit(model, walks, behavior, prior=prior, terms=variant.terms, options=options, optimizer=variant.optimizer)
    planner = ModelPlanner(fit.model, partial(config.reward.reach, fit.model.blank))
    blocked = np.asarray(fit.model.blocked)
    everywhere, visited = np.ones(world.truth.shape, dtype=bool), walks.visited_state_goals()
    scores = ss.evaluate(planner, blocked, world.truth, everywhere, visited).to_dict()
    paths, _ = ss.plan_paths(planner, np.array(world.starts), np.array(world.goals))
    fitted = {"objective": fit.final.objective, "converged": fit.converged, "message": fit.message}
    return {**scores, **fitted}, Panel(title, world.truth, blocked, world.truth, paths, world.starts, world.goals)
