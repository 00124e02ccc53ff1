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
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PRNGKeyArray

from sidestep._typing import FloatTree, Tree
from sidestep.continuous.dynamics import Dynamics, Real
from sidestep.continuous.estimators import jackknife, sample_surrogates
from sidestep.continuous.likelihood import ActionLikelihood, FitProblem
from sidestep.continuous.planner import PlannerState, policy_gaps
from sidestep.continuous.policies import Agent, Critic, FinitePolicy, Starts
from sidestep.continuous.rollouts import Rollout, q_estimates
from sidestep.continuous.tasks import ContinuousTask, task_at, task_features

_ROLLOUTS = 2**13
"""The most rollouts at a time, for their memory."""


class Halves(NamedTuple):
    """What both halves of the rollouts say of some moves.

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
        yield Halves(*(np.asarray(part, np.float64)[:, : count - index * size] for part in parts))


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
    choice_key, rollout_key = jax.random.split(key)
    tasks, states, observed = task_at(demos.tasks, demos.task[moves]), demos.states[moves], demos.actions[moves]
    drawn, probabilities = planner.candidate_actions(choice_key, agent.policy, tasks, states)
    likelihood = ActionLikelihood(agent, Starts(tasks, states, drawn), observed)
    starts, probabilities = likelihood.candidates(probabilities)
    half = samples // 2

    def of_candidate(task: Tree, state: Array, choice: Array, key: PRNGKeyArray) -> tuple[Array, tuple]:
        """Return ∇Q of both halves of the rollouts; Q and what is left at the end of each rollout."""
        start = Starts(jax.tree.map(lambda leaf: leaf[None], task), state[None], choice[None, None])
        size = {"horizon": planner.horizon, "samples": 2 * half}

        def means(parameters: FloatTree) -> tuple[Array, tuple]:
            surrogates, rollouts = sample_surrogates(agent, parameters, start, key, critic, problem.estimator, **size)
            of_each = q_estimates(rollouts)[..., 0], _ends(rollouts, critic)
            of_each = jax.tree.map(lambda leaf: leaf.reshape(2, half), of_each)
            return surrogates.reshape(2, half).mean(axis=1), of_each

        slopes, of_each = jax.jacrev(means, has_aux=True)(agent.dynamics.parameters)
        return jax.vmap(lambda slope: ravel_pytree(slope)[0])(slopes), of_each

    # the candidates of one start share their random numbers
    of_start = jax.vmap(of_candidate, (None, None, 0, None))
    keys = jax.random.split(rollout_key, len(moves))
    by_candidate = jax.vmap(of_start)(starts.tasks, starts.states, starts.choices, keys)
    # the halves first
    slopes, (q, ends) = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 2, 0), by_candidate)
    pi = likelihood.probabilities(q.mean(axis=(0, -1)))
    # drawn choices have less spread than the policy, by the part that each has in their mean
    drawn_again = 0.0 if isinstance(agent.policy, FinitePolicy) else jnp.sum(pi**2, axis=1)[:, None, None]
    beyond = slopes - jnp.sum(pi[..., None] * slopes, axis=2, keepdims=True)
    factors = agent.behavior.beta * jnp.sqrt(pi[..., None] / (1 - drawn_again)) * beyond
    weights = jnp.stack([jackknife(likelihood.weights, each) for each in q[::-1]])  # each half has those of the other
    scores = jnp.sum(weights[..., None] * slopes, axis=2)
    left = agent.behavior.beta * ends.value.mean(axis=-1)
    left = left - jnp.sum(pi * left, axis=-1, keepdims=True)
    unfinished = jnp.sum(pi * ends.unfinished.mean(axis=(0, -1)), axis=-1)
    gaps = policy_gaps(agent.behavior, _advantages(agent, starts), jnp.concatenate(q, axis=-1), probabilities)
    return Halves(factors, scores, gaps[None], jnp.sum(pi * left[0] * left[1], axis=-1)[None] / 2, unfinished[None])


def _advantages(agent: Agent[Any], starts: Starts) -> Float[Array, "starts candidates"]:
    """Return q_λ of every candidate."""
    features = task_features(starts.tasks, starts.states)
    log_probs = jax.vmap(jax.vmap(agent.policy.log_prob, (None, 0)))(features, starts.choices)
    return log_probs + jax.vmap(agent.policy.entropy)(features)[:, None]


def _ends(rollouts: Rollout, critic: Critic) -> _Ends:
    """Return what is left at the end of each rollout; the critic's value there is that of a whole horizon."""
    moves = rollouts.acting.shape[-1]

    def end(task: ContinuousTask, state: Array, acting: Array) -> tuple[Real, Real]:
        going_on = task.discount**moves * (acting & ~task.terminal(state))
        ending = type(task).terminal is not ContinuousTask.terminal
        # the critic is fitted from the second move on
        return going_on * critic(task.features(state), jnp.asarray(1 - 1 / moves)), going_on * ending

    function = end
    for _ in rollouts.acting.shape[:-1]:
        function = jax.vmap(function)
    last = rollouts.states[(slice(None),) * (rollouts.acting.ndim - 1) + (-1,)]
    return _Ends(*function(rollouts.task, last, rollouts.acting[..., -1]))
