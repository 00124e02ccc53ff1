"""What `rollouts.py` times: updates of a model as `fit` makes them, and their parts."""

import time
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from measuring import in_turns, median, note, seconds_of
from sidestep.continuous import (
    ContinuousTask,
    Critic,
    Dynamics,
    FinitePolicy,
    Hold,
    ObstacleMotion,
    Pendulum,
    Planner,
    Planning,
    RollOut,
    Schedule,
    finite_policy,
    fit,
    gather,
    radial_field,
    roll_outs,
    stack,
    value_gradient,
)
from sidestep.continuous.estimators import Estimator
from sidestep.continuous.tasks import task_at
from sidestep.experiments import pendulum as swinging
from sidestep.experiments import room as walking
from sidestep.tabular.backups import Behavior, LogSumExp
from sidestep.tabular.demonstrations import Demonstrations, Trajectory
from sidestep.worlds.continuous_room import room, starts

CASES = ("room, score", "pendulum, score", "pendulum, pathwise")
_WALKERS, _WIDTH = 25, 48


class Case(NamedTuple):
    """A fit: of which dynamics, to what, by whom, and how; a batch is of so many `moves`."""

    dynamics: Dynamics
    demonstrations: Demonstrations
    behavior: Behavior
    policy: FinitePolicy
    planner: Planner
    moves: int
    estimator: Estimator


class Batch(eqx.Module):
    """What one update looks at."""

    tasks: ContinuousTask
    states: Float[Array, "places dimensions"]
    chosen: Int[Array, " places"]
    choices: Int[Array, "places options"]
    shares: Float[Array, "places options"]


def case_of(name: str) -> Case:
    """The fit of that name."""
    world, estimator = name.split(", ")
    random = np.random.default_rng(0)
    if world == "room":
        rooms, planner, moves, behavior = room(), walking.PLANNER, walking.SCHEDULE.moves, walking.people()
        known = rooms.dynamics
        field = radial_field(known.low, known.high, (walking.CENTRES, walking.CENTRES), walking.PRIOR_MEAN)
        dynamics = ObstacleMotion(field, known.low, known.high, known.noise)
        tasks, actions, begins = rooms.tasks, rooms.actions, starts(rooms, _WALKERS, random)
    else:
        dynamics, planner, moves = Pendulum(noise=swinging.NOISE), swinging.PLANNER, swinging.SCHEDULE.moves
        behavior = Behavior(LogSumExp(), swinging.BETA)
        tasks = [Hold(jnp.asarray(goal), jnp.asarray(swinging.DISCOUNT)) for goal in swinging.GOALS]
        actions = jnp.asarray(swinging.TORQUES)[:, None]
        begins = [np.array([goal, 0.0]) + random.uniform(-1, 1, (_WALKERS, 2)) for goal in swinging.GOALS]
    states, task = jnp.asarray(np.concatenate(begins)), jnp.repeat(jnp.arange(len(tasks)), _WALKERS)
    own = task_at(stack(tasks), task)
    seen = jax.vmap(lambda task, state: task.features(state))(own, states)
    policy = finite_policy(jax.random.key(0), actions, seen, width=_WIDTH)
    trajectories = [
        Trajectory(np.stack([state, state + random.normal(0, 0.1, 2)]), random.integers(len(actions), size=1), index)
        for state, index in zip(np.asarray(states), task.tolist(), strict=True)
    ]
    kind: Estimator = "pathwise" if estimator == "pathwise" else "score"
    return Case(dynamics, gather(trajectories, tasks), behavior, policy, planner, moves, kind)


def timed(name: str, turns: int, iterations: int) -> dict[str, float | int | str]:
    """The record of one fit: medians over turns, in each of which a fit goes on for so many iterations."""
    case = case_of(name)
    planner, demos = case.planner, case.demonstrations
    key = jax.random.key(2)
    looked = jax.random.choice(key, len(demos), (case.moves,), replace=False)
    tasks, states = task_at(demos.tasks, demos.task[looked]), demos.states[looked]
    note(f"{name}: compiling")
    planning, _ = _fitted(case, iterations)
    choices, shares = planner.tried(key, case.policy, tasks, states)
    batch = Batch(tasks, states, demos.actions[looked], choices, shares)
    rolled = _roll(case.dynamics, case.policy, case.behavior, planner, batch, key)
    given = (case.dynamics, planning, case.behavior, planner, batch)
    calls = {
        "update": lambda: _fitted(case, iterations)[1],
        "roll_outs": lambda: _seconds(_roll, case.dynamics, case.policy, case.behavior, planner, batch, key),
        "both": lambda: _seconds(_model_gradient, *given, case.estimator, key),
        "policy": lambda: _seconds(_policy_step, planning, case.behavior, planner, batch, rolled),
        "critic": lambda: _seconds(_critic_step, planning, case.behavior, planner, batch, rolled),
    }
    for part in ("both", "policy", "critic"):  # the others are compiled by now
        calls[part]()
    note(f"{name}: timing")
    seconds = {part: median(taken) or 0.0 for part, taken in in_turns(calls, turns).items()}
    return {
        "part": "speed",
        "name": name.split(", ")[0],
        "estimator": case.estimator,
        "roll_outs": int(np.prod(rolled.acting.shape[:-1])),
        "horizon": planner.horizon,
        "steps_per_second": rolled.acting.size / seconds["roll_outs"],
        "update_seconds": seconds["update"],
        "roll_outs_seconds": seconds["roll_outs"],
        "model_seconds": seconds["both"] - seconds["roll_outs"],
        "policy_seconds": seconds["policy"],
        "critic_seconds": seconds["critic"],
    }


def _seconds(function, *given) -> float:
    """How long a compiled function takes until its result is there."""
    return seconds_of(lambda: jax.block_until_ready(function(*given)))


def _fitted(case: Case, iterations: int) -> tuple[Planning[FinitePolicy], float]:
    """What a fit knows in the end, and the median time from one report to the next.

    The first report comes after whatever had to be compiled.
    """
    reported: list[float] = []
    found = fit(
        case.dynamics,
        case.demonstrations,
        case.behavior,
        case.policy,
        case.planner,
        estimator=case.estimator,
        schedule=Schedule(iterations=1 + iterations, rehearsals=0, moves=case.moves),
        report=lambda *_: reported.append(time.perf_counter()),
    )
    return found.planning, float(np.median(np.diff(reported)))


@eqx.filter_jit
def _roll(
    dynamics: Dynamics, policy: FinitePolicy, behavior: Behavior, planner: Planner, batch: Batch, key: PRNGKeyArray
) -> RollOut:
    horizon, samples = planner.horizon, planner.samples
    return roll_outs(dynamics, policy, batch.tasks, behavior, key, batch.states, horizon, batch.choices, samples)


@eqx.filter_jit
def _model_gradient(
    dynamics: Dynamics,
    planning: Planning[FinitePolicy],
    behavior: Behavior,
    planner: Planner,
    batch: Batch,
    estimator: Estimator,
    key: PRNGKeyArray,
) -> PyTree:
    """∇ of the actions' log-likelihood, with the roll-outs that it takes."""

    def weigh(q: Array) -> Array:
        return behavior.beta * (jax.nn.one_hot(batch.chosen, q.shape[1]) - jnp.exp(behavior.log_policy(q)))

    gradient, _ = value_gradient(
        dynamics,
        planning.policy,
        batch.tasks,
        behavior,
        key,
        batch.states,
        batch.choices,
        weigh,
        horizon=planner.horizon,
        samples=planner.samples,
        critic=planning.critic,
        estimator=estimator,
    )
    return gradient


@eqx.filter_jit
def _policy_step(planning: Planning, behavior: Behavior, planner: Planner, batch: Batch, rolled: RollOut) -> PyTree:
    """A step of the policy; the compiler leaves out the critic's, for nobody asks for it."""
    improved, _ = planner.improve(planning, batch.tasks, behavior, rolled, batch.shares)
    return improved.policy


@eqx.filter_jit
def _critic_step(planning: Planning, behavior: Behavior, planner: Planner, batch: Batch, rolled: RollOut) -> Critic:
    """A step of the critic; the compiler leaves out the policy's."""
    improved, _ = planner.improve(planning, batch.tasks, behavior, rolled, batch.shares)
    return improved.critic
