"""What two independent halves of many rollouts say of demonstrated moves, batch by batch.

With u and w from the halves, (u + w)/2 is their estimate, (u − w)/2 has its noise, and u w has the mean of a square
without that noise.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from sidestep.continuous.dynamics import Dynamics, Real
from sidestep.continuous.estimators import half_gradients, jackknife
from sidestep.continuous.gaps import policy_gaps
from sidestep.continuous.likelihood import ActionLikelihood, FitProblem
from sidestep.continuous.planner import PlannerState
from sidestep.continuous.policies import Agent, Critic, FinitePolicy, Starts
from sidestep.continuous.rollouts import Rollout, q_estimates, returns_to_go, sample_rollout
from sidestep.continuous.tasks import ContinuousTask, task_at, task_features

_ROLLOUTS = 2**13
"""The most rollouts at a time, for their memory."""


class Halves(NamedTuple):
    """What both halves of the rollouts say of some moves, each by its weight.

    Attributes:
        factors: √π β (∇Q − Σ π ∇Q) of every candidate.
        scores: The gradients of ln π of the observed choices.
        policy_gaps: Those of the moves' states (`policy_gaps`).
        beyond_horizon: How far the values at the ends of rollouts would move the policy, in nats.
        unfinished: The share of rollouts that end before their task does, discounted; 0 for tasks without an end.
    """

    factors: Float[Array | np.ndarray, "2 moves candidates parameters"]
    scores: Float[Array | np.ndarray, "2 moves parameters"]
    policy_gaps: Float[Array | np.ndarray, "1 moves"]
    beyond_horizon: Float[Array | np.ndarray, "1 moves"]
    unfinished: Float[Array | np.ndarray, "1 moves"]


class _Ends(NamedTuple):
    """The discounted value at the end of a rollout, and whether its task had not ended, discounted."""

    value: Array
    unfinished: Array


def gather_halves(
    problem: FitProblem, dynamics: Dynamics, planner_state: PlannerState[Any], samples: int, key: PRNGKeyArray
) -> Iterator[Halves]:
    """Yield what both halves of the rollouts say of all moves, batch by batch.

    Args:
        problem: Demonstrations and settings.
        dynamics: The family at θ.
        planner_state: The agent's policy and critic at θ.
        samples: Rollouts of each candidate action, 2 or more.
        key: Draws everything random.
    """
    agent = replace(problem.agent, dynamics=dynamics, policy=planner_state.policy)
    policy, count = agent.policy, len(problem.demonstrations)
    candidates = len(policy.actions) if isinstance(policy, FinitePolicy) else 1 + problem.planner.candidates
    size = min(count, max(1, _ROLLOUTS // (samples * candidates)))
    moves = np.resize(np.arange(count), (-(-count // size), size))  # the last batch is filled up with the first moves
    for index, batch in enumerate(moves):
        drawing = jax.random.fold_in(key, index)
        parts = _batch_halves(problem, agent, planner_state, drawing, jnp.asarray(batch), samples)
        halves = Halves(*(np.asarray(part, np.float64)[:, : count - index * size] for part in parts))
        yield _weighed(halves, np.asarray(problem.demonstrations.weights, np.float64)[batch[: count - index * size]])


def _weighed(halves: Halves, weights: np.ndarray) -> Halves:
    """Return the halves of moves that count as often as their weights say."""
    factors = np.sqrt(weights)[:, None, None] * halves.factors
    return Halves(factors, weights[:, None] * halves.scores, *(weights * figures for figures in halves[2:]))


@eqx.filter_jit
def _batch_halves(
    problem: FitProblem,
    agent: Agent[Any],
    planner_state: PlannerState[Any],
    key: PRNGKeyArray,
    moves: Array,
    samples: int,
) -> Halves:
    demos, planner, critic = problem.demonstrations, problem.planner, planner_state.critic
    tasks, states, observed = task_at(demos.tasks, demos.task[moves]), demos.states[moves], demos.actions[moves]
    finite = isinstance(agent.policy, FinitePolicy)
    sets = []
    for index in range(1 if finite else 2):
        choice_key, rollout_key = jax.random.split(jax.random.fold_in(key, index))
        drawn, probabilities = planner.candidate_actions(choice_key, agent.policy, tasks, states)
        likelihood = ActionLikelihood(agent, Starts(tasks, states, drawn), observed)
        sets.append(_of_candidates(problem, likelihood, critic, probabilities, rollout_key, samples // 2))
    if finite:
        return sets[0]
    # each half of the scores has candidates of its own, so that their difference has the noise of drawing these
    factors = jnp.concatenate([each.factors for each in sets], axis=2) / jnp.sqrt(2.0)
    scores = jnp.stack([each.scores.mean(axis=0) for each in sets])
    figures = (jnp.stack(parts).mean(axis=0) for parts in zip(*(each[2:] for each in sets), strict=True))
    return Halves(factors, scores, *figures)


def _of_candidates(
    problem: FitProblem,
    likelihood: ActionLikelihood,
    critic: Critic,
    probabilities: Array,
    key: PRNGKeyArray,
    half: int,
) -> Halves:
    """Return what the rollouts of some candidates say; `probabilities` are those of the drawn ones."""
    agent, beta = likelihood.agent, likelihood.agent.behavior.beta
    starts, probabilities = likelihood.candidates(probabilities)
    rollout_key, end_key = jax.random.split(key)
    size = {"horizon": problem.planner.horizon, "half": half}
    slopes, rollouts = half_gradients(agent, starts, rollout_key, critic, problem.estimator, **size)
    of_each = q_estimates(rollouts)[..., 0], _ends(agent, rollouts, critic, end_key)
    # the halves first
    q, ends = jax.tree.map(lambda leaf: jnp.moveaxis(leaf.reshape(*leaf.shape[:2], 2, half), 2, 0), of_each)
    pi = likelihood.probabilities(q.mean(axis=(0, -1)))
    # drawn choices have less spread than the policy, by the part that each has in their mean
    drawn_again = 0.0 if isinstance(agent.policy, FinitePolicy) else jnp.sum(pi**2, axis=1)[:, None, None]
    beyond = slopes - jnp.sum(pi[..., None] * slopes, axis=2, keepdims=True)
    factors = beta * jnp.sqrt(pi[..., None] / (1 - drawn_again)) * beyond
    weights = jnp.stack([jackknife(likelihood.weights, each) for each in q[::-1]])  # each half has those of the other
    scores = jnp.sum(weights[..., None] * slopes, axis=2)
    left = beta * ends.value.mean(axis=-1)
    left = left - jnp.sum(pi * left, axis=-1, keepdims=True)
    unfinished = jnp.sum(pi * ends.unfinished.mean(axis=(0, -1)), axis=-1)
    gaps = policy_gaps(agent.behavior, _advantages(agent, starts), jnp.concatenate(q, axis=-1), probabilities)
    return Halves(factors, scores, gaps[None], jnp.sum(pi * left[0] * left[1], axis=-1)[None] / 2, unfinished[None])


def _advantages(agent: Agent[Any], starts: Starts) -> Float[Array, "starts candidates"]:
    """Return q_λ of every candidate."""
    features = task_features(starts.tasks, starts.states)
    log_probs = jax.vmap(jax.vmap(agent.policy.log_prob, (None, 0)))(features, starts.choices)
    return log_probs + jax.vmap(agent.policy.entropy)(features)[:, None]


def _ends(agent: Agent[Any], rollouts: Rollout, critic: Critic, key: PRNGKeyArray) -> _Ends:
    """Return what is left at the end of each rollout: the critic's value there, which is that of a whole horizon.

    With a horizon of one move no critic is fitted; one more move takes its place.
    """
    moves = rollouts.acting.shape[-1]
    keys = jax.random.split(key, rollouts.acting.shape[::2])  # the candidates of a start share their random numbers

    def end(task: ContinuousTask, state: Array, acting: Array, key: PRNGKeyArray) -> tuple[Real, Real]:
        going_on = task.discount**moves * (acting & ~task.terminal(state))
        if moves == 1:
            value = returns_to_go(sample_rollout(agent, task, key, state, 1))[0]
        else:  # the critic is fitted from the second move on
            value = critic(task.features(state), jnp.asarray(1 - 1 / moves))
        return going_on * value, going_on * task.can_end

    of_samples = jax.vmap(end)
    of_candidates = jax.vmap(of_samples, (0, 0, 0, None))
    return _Ends(*jax.vmap(of_candidates)(rollouts.task, rollouts.states[:, :, :, -1], rollouts.acting[..., -1], keys))
