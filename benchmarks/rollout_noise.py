"""How noisy the estimators of eq. 11 are: the problems that `rollouts.py` tries them on, and one roll-out's gradient.

Dynamics, policy, first state and first action are held fixed, and every roll-out gives one estimate of ∇_θ Q^π(s, a).
The policy is the one that people find who look as far ahead as the longest roll-outs, so that it is the same for all
lengths; each length gets a critic of its own for it.
"""

import time
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Key, PRNGKeyArray

from measuring import in_turns, median
from sidestep.continuous import (
    ContinuousTask,
    Critic,
    Dynamics,
    Hold,
    LinearGaussian,
    Pendulum,
    Planner,
    Policy,
    QuadraticTask,
    finite_policy,
    gaussian_policy,
    plan,
    stack,
    value_gradient,
)
from sidestep.continuous.estimators import Estimator
from sidestep.tabular.backups import Behavior, LogSumExp

PEOPLE = Behavior(LogSumExp(), 2.0)
DISCOUNT = 0.95
ESTIMATORS = ("score", "score and critic", "pathwise")
PROBLEMS = ("linear, stable", "linear, unstable", "pendulum, hanging", "pendulum, upright")
_PLACES, _STARTS, _UNMOVED = 16, 128, 1e-30
_PLANNER = Planner(horizon=1, places=16, samples=2, options=4, learning_rate=0.02, critic_rate=0.01, critic_width=32)


class Problem(eqx.Module):
    """Dynamics whose gradient is wanted, a task in them, where roll-outs may start, and a policy."""

    dynamics: Dynamics
    task: ContinuousTask
    states: Float[Array, "starts dimensions"]
    policy: Policy


class Noise(NamedTuple):
    """What many estimates of the same gradients have shown.

    - `mean`: over all of them, a parameter; `error`: its standard error.
    - `deviation`: the standard deviation of one estimate, as a norm over parameters.
    - `square`: the squared norm of the gradient, the mean over places.
    - `seconds`: for one roll-out and its gradient, the median over turns.
    """

    mean: Float[np.ndarray, " parameters"]
    error: Float[np.ndarray, " parameters"]
    deviation: float
    square: float
    seconds: float


def problem_of(name: str) -> Problem:
    """The problem of that name, its policy as it begins."""
    kind, place = name.split(", ")
    random, discount = np.random.default_rng(0), jnp.asarray(DISCOUNT)
    if kind == "linear":
        growth = 0.9 if place == "stable" else 1.05
        turn = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
        dynamics = LinearGaussian(jnp.asarray(growth * turn), jnp.array([[0.0], [0.5]]), jnp.full(2, 0.1))
        task = QuadraticTask(jnp.zeros(2), jnp.eye(2), 0.1 * jnp.eye(1), discount)
        states = jnp.asarray(random.uniform(-1, 1, (_STARTS, 2)))
        examples = jax.vmap(task.features)(states)
        return Problem(dynamics, task, states, gaussian_policy(jax.random.key(1), 1, examples, spread=0.5, depth=0))
    angle = np.pi if place == "hanging" else 0.0
    task = Hold(jnp.asarray(angle), discount)
    states = jnp.asarray(np.array([angle, 0.0]) + random.uniform(-0.4, 0.4, (_STARTS, 2)))
    examples, torques = jax.vmap(task.features)(states), jnp.linspace(-2.0, 2.0, 5)[:, None]
    return Problem(Pendulum(), task, states, finite_policy(jax.random.key(1), torques, examples, width=32))


def planned(problem: Problem, horizon: int, steps: int, *, moving: bool = True) -> tuple[Policy, Critic]:
    """A policy for the problem and a critic for the policy; unless it is `moving`, the policy stays as it is."""
    planner = replace(_PLANNER, horizon=horizon, learning_rate=_PLANNER.learning_rate if moving else _UNMOVED)
    tasks, task = stack([problem.task]), jnp.zeros(_STARTS, jnp.int32)
    states, policy = problem.states, problem.policy
    found = plan(problem.dynamics, tasks, PEOPLE, policy, states, task, planner, steps=steps)
    return found.policy, found.planning.critic


def measured(problem: Problem, critic: Critic, horizon: int, samples: int, turns: int) -> dict[str, Noise]:
    """What each of the estimators shows, all with the same random numbers."""
    gradients: dict[str, list[np.ndarray]] = {name: [] for name in ESTIMATORS}
    keys = jax.random.key(2)
    drawing = jax.random.split(jax.random.fold_in(keys, 0), _PLACES)
    seen = jax.vmap(problem.task.features)(problem.states[:_PLACES])
    choices = jax.vmap(problem.policy.sample)(drawing, seen)

    def call(name: str) -> float:
        key = jax.random.fold_in(keys, 1 + len(gradients[name]))
        own, estimator = (None if name == "score" else critic), ("pathwise" if name == "pathwise" else "score")
        started = time.perf_counter()
        found = _estimates(problem, own, estimator, key, choices, horizon, samples)
        gradients[name].append(np.asarray(found))
        return (time.perf_counter() - started) / (samples * _PLACES)

    taken = in_turns({name: lambda name=name: call(name) for name in ESTIMATORS}, 1 + turns)
    # the first call of each was compiled in
    return {name: noise_of(np.concatenate(gradients[name], axis=1), median(taken[name][1:])) for name in ESTIMATORS}


@eqx.filter_jit
def _estimates(
    given: Problem,
    critic: Critic | None,
    estimator: Estimator,
    key: PRNGKeyArray,
    choices: Array,
    horizon: int,
    samples: int,
) -> Float[Array, "places samples parameters"]:
    """The gradient that each roll-out gives by itself."""
    tasks = stack([given.task])

    def one(state: Array, choice: Array, key: Key[Array, ""]) -> Array:
        gradient, _ = value_gradient(
            given.dynamics,
            given.policy,
            tasks,
            PEOPLE,
            key,
            state[None],
            choice[None, None],
            jnp.ones_like,
            horizon=horizon,
            samples=1,
            critic=critic,
            estimator=estimator,
        )
        return ravel_pytree(gradient)[0]

    keys = jax.random.split(key, (_PLACES, samples))
    return jax.vmap(jax.vmap(one, (None, None, 0)))(given.states[:_PLACES], choices, keys)


def noise_of(gradients: Float[np.ndarray, "places samples parameters"], seconds: float | None) -> Noise:
    """What estimates of the gradients of several places show."""
    places, samples, _ = gradients.shape
    means, variances = gradients.mean(axis=1), gradients.var(axis=1, ddof=1)
    variance = float(variances.sum(axis=-1).mean())
    return Noise(
        mean=means.mean(axis=0),
        error=np.sqrt(variances.mean(axis=0) / (places * samples)),
        deviation=float(np.sqrt(variance)),
        # the squares of means hold a share of their variance
        square=float((means**2).sum(axis=-1).mean()) - variance / samples,
        seconds=seconds or 0.0,
    )
