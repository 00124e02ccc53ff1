"""The paper's section "Motivation": what one loses who explains detours by what places cost.

People walk optimally, ties broken at random, in two rooms with a door between them and mud in the right one: a move
into mud fails four times out of five. From the same walks a global cost function is learned (`maxent_irl`: no move
fails,
cells cost something), and a transition model (`behavior_aware`: nothing costs anything, moves fail). Then the reward
changes: the goal lies elsewhere, once in the mud, and what is at stake is larger or smaller. A robot plans with what
was learned. It may also stay where it is for ever, which is worth nothing, and does so where no plan is worth more.

The reward comes in two forms. With a `goal` that pays w and a discount below 1, people could stay away as well. With
`steps` that cost something and discount 1 they must arrive: the constraint by which Ziebart (2010) helps the cost
function. At stakes k the robot's goal pays k·w and its steps cost k times as much. In the true world that changes no
plan, and in both forms it is worth going from everywhere.
"""

import time
from collections.abc import Callable
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, Shaped

from sidestep._files import write_json
from sidestep.baselines.interface import ModelResult, behavior_aware
from sidestep.baselines.maxent_irl import maxent_irl
from sidestep.maps.config import BehaviorConfig, MapConfig
from sidestep.maps.fit import behavior_of
from sidestep.plotting.maps import save
from sidestep.plotting.policies import Curves, PolicyPanel, figure_policies
from sidestep.robots.robot import risk_averse_robot
from sidestep.tabular.demonstrations import Demonstrations, gather
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.planning import plan
from sidestep.tabular.reward import Reward
from sidestep.tabular.simulation import simulate
from sidestep.tabular.tasks import Task
from sidestep.worlds.rooms import two_rooms

ROWS, COLUMNS, DOOR = 9, 13, 8
MUD, MUD_FAILS = (slice(2, 5), slice(8, 11)), 0.8
GOALS = ((0, 0), (7, 1), (3, 5), (0, 7), (0, 12), (3, 12), (6, 7), (8, 12), (4, 3))
NEW_GOALS = ((3, 9), (2, 2), (5, 7), (7, 10), (1, 1))
"""Cells (row, column); the first of the new ones lies in the mud."""
WALKERS, DRAWS = 10, 5
"""People to each goal, and how often all is done with other people."""
STAKES = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
METHODS = {"costs": maxent_irl, "behavior": behavior_aware}
OUTCOMES = ("arrives", "stays_put", "bumps")
TITLES = {
    "goal": "The goal pays 1 × stakes, discount .95: people may stay away",
    "steps": "Steps cost 1 × stakes and the goal pays 40 × stakes, discount 1: people must arrive",
}


class Form(NamedTuple):
    """A form of reward: what the goal pays at stakes 1, and how people are taken to act.

    They are optimal, so β is large, which keeps the cells' costs small: with smaller ones, dear cells stand for sharp
    choices too, and the robot stays put the more.
    """

    worth: float
    config: MapConfig


FORMS = {
    "goal": Form(1.0, MapConfig(Reward(0.95), BehaviorConfig(beta=200.0))),
    "steps": Form(40.0, MapConfig(Reward(1.0, 1.0), BehaviorConfig(beta=10.0))),
}


class Trial(NamedTuple):
    """What a robot does from every cell that one can stand on, one after another.

    - `starts`, `intended`: the states it may start from, and where its first move is to lead.
    - `outcomes`: that it "arrives", "stays_put" (or goes round in circles) or "bumps" into a wall.
    - `expected`, `fewest`: how many moves its path takes on average in the true world (where it arrives), and the best.
    """

    starts: Int[np.ndarray, " starts"]
    intended: Int[np.ndarray, " starts"]
    outcomes: Shaped[np.ndarray, " starts"]
    expected: Float[np.ndarray, " starts"]
    fewest: Float[np.ndarray, " starts"]


def true_world() -> ObstacleGrid:
    """The two rooms as they are: walls are known, and mud is what fails now and then."""
    known = two_rooms(ROWS, COLUMNS, DOOR).known.copy()
    known[MUD] = Cell.UNKNOWN
    return ObstacleGrid(Grid(known), np.log(MUD_FAILS / (1 - MUD_FAILS)))


def run(folder: Path, seed: int = 0, report: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Runs the experiment, writes `motivation.png` and `summary.json` to a folder, and returns the summary."""
    started = time.monotonic()
    forms, panels = {}, []
    for name, form in FORMS.items():
        draws = []
        for draw in range(DRAWS):
            report(f"the reward's form is {name}: people {draw + 1} of {DRAWS}")
            demonstrations = walks(form, seed + draw)
            known = learned(form, demonstrations)
            draws.append({method: _all_tried(each, form) for method, each in known.items()})
            panels = panels or _panels(known, draws[0], demonstrations)
        forms[name] = {method: _figures([draw[method] for draw in draws]) for method in draws[0]}
    costs, behavior = forms["goal"]["costs"], forms["goal"]["behavior"]
    summary = {
        "command": "experiment motivation",
        "seed": seed,
        "draws": DRAWS,
        "stays_put_by_costs_at_the_smallest_stakes": costs["stays_put"][0],
        "bumps_by_costs_at_the_largest_stakes": costs["bumps"][-1],
        "arrives_by_behavior_at_least": min(behavior["arrives"]),
        "stakes": list(STAKES),
        "forms": forms,
        "settings": {name: asdict(form.config) | {"worth": form.worth} for name, form in FORMS.items()},
        "seconds": round(time.monotonic() - started, 1),
    }
    curves = [
        Curves(TITLES[name], STAKES, {method: {key: own[method][key] for key in OUTCOMES} for method in METHODS})
        for name, own in forms.items()
    ]
    save(figure_policies(panels, curves), folder / "motivation.png")
    write_json(folder / "summary.json", summary)
    return summary


def walks(form: Form, seed: int) -> Demonstrations:
    """Walks of people who know the world and go the best ways, from dry places."""
    world, reward, random = true_world(), form.config.reward, np.random.default_rng(seed)
    goals, dry = [_state(goal) for goal in GOALS], np.flatnonzero(np.asarray(world.known) == Cell.FREE)
    tasks = [reward.reach(_blank(), goal) for goal in goals]
    starts = [random.choice(np.setdiff1d(dry, [goal]), WALKERS) for goal in goals]
    return gather(simulate(jax.random.key(seed), world, tasks, starts), tasks)


def learned(form: Form, demonstrations: Demonstrations) -> dict[str, ModelResult]:
    """The truth, and what each method makes of the walks on a map of which nothing is known."""
    world, config = true_world(), form.config
    truth = ModelResult(
        world,
        config.reward,
        behavior_of(config.behavior),
        np.asarray(world.blocked),
        risk_averse_robot(world, []),
        True,
    )
    return {"truth": truth} | {name: learn(_blank(), demonstrations, config) for name, learn in METHODS.items()}


def at_stakes(known: ModelResult, form: Form, goal: int, stakes: float) -> Task:
    """The task of reaching a state where all that it pays and that steps cost is `stakes` times as much.

    What cells cost stays as it was learned: a global cost function knows nothing of tasks.
    """
    own = known.reward.reach(_blank(), goal)
    bare = form.config.reward.reach(_blank(), goal)
    final = jnp.full((1,), stakes * form.worth)
    return Task(own.reward + (stakes - 1) * bare.reward, final, own.terminal, own.discount)


def tried(known: ModelResult, form: Form, goal: int, stakes: float) -> Trial:
    """What a robot does that plans, optimally, with what was learned."""
    world = true_world()
    made = plan(known.model, at_stakes(known, form, goal, stakes))
    fails = np.asarray(world.blocked).ravel()
    starts = np.setdiff1d(np.flatnonzero(fails < 1), [goal])
    paths = made.follow(starts)
    bumps = np.array([bool((fails[path[1:]] == 1).any()) for path in paths])
    away = np.asarray(made.solution.values)[starts] <= 0
    stays = away | (~bumps & (np.array([path[-1] for path in paths]) != goal))
    outcomes = np.where(stays, "stays_put", np.where(bumps, "bumps", "arrives"))
    with np.errstate(divide="ignore"):
        expected = np.array([np.sum(1 / (1 - fails[path[1:]])) for path in paths])
    return Trial(starts, np.asarray(made.intended)[starts], outcomes, expected, _fewest_moves(goal)[starts])


@cache
def _fewest_moves(goal: int) -> Float[np.ndarray, " states"]:
    """How many moves the best way from each state takes on average in the true world."""
    task = Reward(discount=1.0, step_cost=1.0).reach(_blank(), goal)
    return -np.asarray(plan(true_world(), task).solution.values)


def _all_tried(known: ModelResult, form: Form) -> list[list[Trial]]:
    """Trials by goal and stakes."""
    return [[tried(known, form, _state(goal), stakes) for stakes in STAKES] for goal in NEW_GOALS]


def _figures(draws: list[list[list[Trial]]]) -> dict[str, Any]:
    """Shares of starts, and how long the paths of those who arrive are: trials by draw, goal and stakes."""

    def of(trials: list[Trial]) -> dict[str, float | None]:
        outcomes = np.concatenate([trial.outcomes for trial in trials])
        arrives = outcomes == "arrives"
        ratio = np.concatenate([trial.expected / trial.fewest for trial in trials])[arrives]
        shares = {name: float(np.mean(outcomes == name)) for name in OUTCOMES}
        return shares | {"relative_length": float(ratio.mean()) if len(ratio) else None}

    def over_stakes(goals: slice) -> dict[str, list[float | None]]:
        at = [of([own[index] for draw in draws for own in draw[goals]]) for index in range(len(STAKES))]
        return {name: [figures[name] for figures in at] for name in at[0]}

    return over_stakes(slice(None)) | {"goal_in_mud": over_stakes(slice(0, 1))}


def _state(cell: tuple[int, int]) -> int:
    return cell[0] * COLUMNS + cell[1]


def _blank() -> Grid:
    return Grid.unknown(ROWS, COLUMNS)


def _panels(
    known: dict[str, ModelResult], trials: dict[str, list[list[Trial]]], demonstrations: Demonstrations
) -> list[PolicyPanel]:
    """The walks, what was learned from them, and what robots do with it that are to reach the first goal."""
    truth, goal, paths = two_rooms(ROWS, COLUMNS, DOOR), _state(NEW_GOALS[0]), demonstrations.paths()
    panels = [PolicyPanel(f"{len(paths)} walks", known["truth"].ranking, "P(a move fails)", 1.0, truth, walks=paths)]
    middle, last = len(STAKES) // 2, len(STAKES) - 1
    for method, index in (("costs", 0), ("costs", middle), ("costs", last), ("behavior", middle)):
        trial, ranking = trials[method][0][index], known[method].ranking
        label, most = ("cost, in units of the goal", ranking.max()) if method == "costs" else ("P(blocked)", 1)
        policy = trial.starts, trial.intended, trial.outcomes == "stays_put"
        title = f"{method}, stakes {STAKES[index]:g}"
        panels.append(PolicyPanel(title, ranking, label, float(most), truth, goal, *policy))
    return panels
