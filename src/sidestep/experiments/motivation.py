"""The paper's section "Motivation": what goes wrong if costs of cells explain detours.

Agents walk optimally, ties broken at random, in two rooms with a door between them and mud in the right one: a move
into mud fails four times out of five. Two methods learn from the same walks: costs of cells in free space
(`maxent_irl`), and a transition model without costs (`behavior_aware`). Then the reward changes: the goal is another
cell, once in the mud, and the stakes are higher or lower. A robot plans in what was learned. It may also stay in place
forever at value 0, and does so where no plan has a higher value.

The reward has two forms. In the form `goal` the goal pays w and the discount is below 1, so agents may stay away. In
the form `steps` each step has a cost and the discount is 1, so they must arrive; Ziebart (2010) uses this constraint to
help the cost function. At stakes k the robot's goal pays k·w and its steps cost k times as much. In the true world this
changes no plan, and in both forms every state has a plan of positive value.
"""

import time
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, Shaped

import sidestep as ss
from sidestep.baselines.behavior_aware import behavior_aware
from sidestep.baselines.interface import ModelResult
from sidestep.baselines.maxent_irl import maxent_irl
from sidestep.experiments.output import Notify, Summary, quiet, write_results
from sidestep.maps.fit import behavior_of
from sidestep.plotting.policies import Curves, PolicyPanel, figure_policies
from sidestep.worlds.rooms import rooms_in_a_row

ROWS, COLUMNS, DOOR = 9, 13, 8
BLANK = ss.Grid.unknown(ROWS, COLUMNS)
MUD, MUD_FAILS = (slice(2, 5), slice(8, 11)), 0.8
METHODS = {"costs": maxent_irl, "behavior": behavior_aware}
OUTCOMES = ("arrives", "stays_put", "bumps")
TITLES = {
    "goal": "The goal pays 1 × stakes, discount .95: agents may stay away",
    "steps": "Steps cost 1 × stakes and the goal pays 40 × stakes, discount 1: agents must arrive",
}
Cells = tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class MotivationConfig:
    """The size of the experiment.

    Attributes:
        draws: The number of independent sets of walks.
        goals: The goals of the agents as cells (row, column).
        walks_per_goal: The number of walks to each goal in a set.
        stakes: The factors k of the robot's reward.
        new_goals: The goals of the robot as cells (row, column); the first lies in the mud.
    """

    draws: int = 5
    goals: Cells = ((0, 0), (7, 1), (3, 5), (0, 7), (0, 12), (3, 12), (6, 7), (8, 12), (4, 3))
    walks_per_goal: int = 10
    stakes: tuple[float, ...] = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
    new_goals: Cells = ((3, 9), (2, 2), (5, 7), (7, 10), (1, 1))


class Form(NamedTuple):
    """A form of reward: what the goal pays at stakes 1, and the configuration of learning.

    The agents are optimal, so β is large. With a smaller β, high costs would explain deterministic choices too, and the
    robot would stay in place more often.
    """

    worth: float
    config: ss.MapConfig


FORMS = {
    "goal": Form(1.0, ss.MapConfig(ss.Reward(0.95), ss.BehaviorConfig(beta=200.0))),
    "steps": Form(40.0, ss.MapConfig(ss.Reward(1.0, 1.0), ss.BehaviorConfig(beta=10.0))),
}


class Trial(NamedTuple):
    """What a robot does from every state that is not blocked, to reach one goal.

    Attributes:
        starts: The start states.
        intended: The intended state after the first move.
        outcomes: "arrives", "stays_put" (or moves in a cycle), or "bumps" into a wall.
        expected: The expected number of moves of the planned path in the true world, if it arrives.
        fewest: The smallest expected number of moves.
    """

    starts: Int[np.ndarray, " starts"]
    intended: Int[np.ndarray, " starts"]
    outcomes: Shaped[np.ndarray, " starts"]
    expected: Float[np.ndarray, " starts"]
    fewest: Float[np.ndarray, " starts"]


Trials = dict[str, list[list[Trial]]]
"""The trials of each method by new goal and stakes."""


def true_world() -> ss.ObstacleGrid:
    """Return the model of the two rooms with known walls and mud."""
    known = rooms_in_a_row(ROWS, COLUMNS, (DOOR,)).known.copy()
    known[MUD] = ss.Cell.UNKNOWN
    return ss.ObstacleGrid(ss.Grid(known), np.log(MUD_FAILS / (1 - MUD_FAILS)))


def run(folder: Path, seed: int = 0, notify: Notify = quiet, config: MotivationConfig | None = None) -> Summary:
    """Run the experiment; write `motivation.png` and `summary.json`.

    Args:
        folder: The folder to write to.
        seed: Draws the walks.
        notify: Called with a line of text at each stage.
        config: The size of the experiment.

    Returns:
        The content of `summary.json`.
    """
    config, started = config or MotivationConfig(), time.monotonic()
    forms, panels, curves = {}, [], []
    for name, form in FORMS.items():
        trials: Trials = {method: [] for method in ("truth", *METHODS)}
        for draw in range(config.draws):
            notify(f"reward of the form {name}: draw {draw + 1} of {config.draws}")
            walks = simulate_walks(form, config, seed + draw)
            results = {method: learn(BLANK, walks, form.config) for method, learn in METHODS.items()}
            results["truth"] = true_result(form)
            for method, own in trials.items():
                for goal in map(_state, config.new_goals):
                    own.append([run_trial(results[method], form, goal, stakes) for stakes in config.stakes])
            panels = panels or _panels(results, trials, walks, config)
        forms[name] = {
            method: _over_stakes(own) | {"goal_in_mud": _over_stakes(own[:: len(config.new_goals)])}
            for method, own in trials.items()
        }
        fractions = {method: {key: forms[name][method][key] for key in OUTCOMES} for method in METHODS}
        curves.append(Curves(TITLES[name], config.stakes, fractions))
    costs, behavior = forms["goal"]["costs"], forms["goal"]["behavior"]
    summary = {
        "draws": config.draws,
        "stays_put_by_costs_at_the_smallest_stakes": costs["stays_put"][0],
        "bumps_by_costs_at_the_largest_stakes": costs["bumps"][-1],
        "arrives_by_behavior_at_least": min(behavior["arrives"]),
        "stakes": list(config.stakes),
        "forms": forms,
        "settings": {name: asdict(form.config) | {"worth": form.worth} for name, form in FORMS.items()},
    }
    return write_results(folder, "motivation", seed, started, figure_policies(panels, curves), summary)


def simulate_walks(form: Form, config: MotivationConfig, seed: int) -> ss.Demonstrations:
    """Return walks of optimal agents that know the world, from states outside the mud.

    Args:
        form: The form of the reward.
        config: The size of the experiment.
        seed: Draws everything random.

    Returns:
        The moves of `config.walks_per_goal` walks to each of `config.goals`.
    """
    world, random = true_world(), np.random.default_rng(seed)
    goals, dry = [_state(goal) for goal in config.goals], np.flatnonzero(np.asarray(world.known) == ss.Cell.FREE)
    tasks = [form.config.reward.reach(BLANK, goal) for goal in goals]
    starts = [random.choice(np.setdiff1d(dry, [goal]), config.walks_per_goal) for goal in goals]
    return ss.gather(ss.simulate(jax.random.key(seed), world, tasks, starts), tasks)


def true_result(form: Form) -> ModelResult:
    """Return the true model as a result.

    Args:
        form: The form of the reward.
    """
    world, behavior = true_world(), behavior_of(form.config)
    ranking, robot = np.asarray(world.blocked), ss.risk_averse_robot(world, [])
    return ModelResult(world, form.config.reward, behavior, ranking, robot, converged=True)


def task_at_stakes(result: ModelResult, form: Form, goal: int, stakes: float) -> ss.Task:
    """Return the task of reaching a state with the goal's pay and the step costs multiplied by the stakes.

    The costs of cells stay as they were learned: a global cost function does not depend on the task.

    Args:
        result: What a method learned.
        form: The form of the reward.
        goal: The state to reach.
        stakes: The factor k of the reward, above 0.
    """
    learned, base = (reward.reach(BLANK, goal) for reward in (result.reward, form.config.reward))
    pay = jnp.full((1,), stakes * form.worth)
    return ss.Task(learned.reward + (stakes - 1) * base.reward, pay, learned.terminal, learned.discount)


def run_trial(result: ModelResult, form: Form, goal: int, stakes: float) -> Trial:
    """Return what a robot does that plans optimally with a method's result.

    Args:
        result: What a method learned.
        form: The form of the reward.
        goal: The state to reach.
        stakes: The factor k of the reward, above 0.

    Returns:
        The outcome at every start.
    """
    robot = ss.plan(result.model, task_at_stakes(result, form, goal, stakes))
    fails = np.asarray(true_world().blocked).ravel()
    starts = np.setdiff1d(np.flatnonzero(fails < 1), [goal])
    paths = robot.follow(starts)
    bumps = np.array([bool((fails[path[1:]] == 1).any()) for path in paths])
    stays = (np.asarray(robot.solution.values)[starts] <= 0) | (~bumps & np.array([path[-1] != goal for path in paths]))
    outcomes = np.where(stays, "stays_put", np.where(bumps, "bumps", "arrives"))
    with np.errstate(divide="ignore"):
        expected = np.array([np.sum(1 / (1 - fails[path[1:]])) for path in paths])
    return Trial(starts, np.asarray(robot.intended)[starts], outcomes, expected, _fewest_moves(goal)[starts])


@cache
def _fewest_moves(goal: int) -> Float[np.ndarray, " states"]:
    """Return the smallest expected number of moves from each state in the true world."""
    return -np.asarray(ss.plan(true_world(), ss.Reward(discount=1.0, step_cost=1.0).reach(BLANK, goal)).solution.values)


def _over_stakes(by_goal: list[list[Trial]]) -> dict[str, Any]:
    """Return the fraction of each outcome and the relative length of paths, for each of the stakes."""
    summary: dict[str, Any] = {name: [] for name in (*OUTCOMES, "relative_length")}
    for trials in zip(*by_goal, strict=True):
        outcomes = np.concatenate([trial.outcomes for trial in trials])
        ratio = np.concatenate([trial.expected / trial.fewest for trial in trials])[outcomes == "arrives"]
        for name in OUTCOMES:
            summary[name].append(float(np.mean(outcomes == name)))
        summary["relative_length"].append(float(ratio.mean()) if len(ratio) else None)
    return summary


def _state(cell: tuple[int, int]) -> int:
    return cell[0] * COLUMNS + cell[1]


def _panels(
    results: dict[str, ModelResult], trials: Trials, walks: ss.Demonstrations, config: MotivationConfig
) -> list[PolicyPanel]:
    """Return panels of the walks, of what was learned, and of robots that plan with it to the first new goal."""
    truth, goal, paths = rooms_in_a_row(ROWS, COLUMNS, (DOOR,)), _state(config.new_goals[0]), walks.paths()
    panels = [PolicyPanel(f"{len(paths)} walks", results["truth"].ranking, "P(a move fails)", 1.0, truth, walks=paths)]
    middle, last = len(config.stakes) // 2, len(config.stakes) - 1
    for method, index in (("costs", 0), ("costs", middle), ("costs", last), ("behavior", middle)):
        trial, ranking = trials[method][0][index], results[method].ranking
        label, most = ("cost, in units of the goal", ranking.max()) if method == "costs" else ("P(blocked)", 1)
        policy = trial.starts, trial.intended, trial.outcomes == "stays_put"
        title = f"{method}, stakes {config.stakes[index]:g}"
        panels.append(PolicyPanel(title, ranking, label, float(most), truth, goal, policy))
    return panels
