"""The information of a fit of continuous dynamics: exact for transitions and prior, by rollouts for actions.

    H = −∇² [Σ_moves ln T_θ(s, a, s′) + log p(θ)] + Σ_moves β² Cov_π(∇Q(s, ·))

The first part is the derivative of its exact gradient, by automatic differentiation. The second is the *expected*
information of the actions, given the states. The observed information has −β Σ_moves (∇²Q(s, a) − Σ π ∇²Q(s, a′))
besides, which has mean 0 under the learned model (McCullagh and Nelder 1989, section 2.5): with many moves it counts
for little, unless the model is wrong. It is left out, because no product of the gradient gives it: Q is known by
rollouts of a policy, the policy is found by gradients too, and paths jump where a choice of a finite set does.

∇Q has the noise of rollouts. Two independent halves of them give the two factors of the covariance, so that noise has
mean 0 in it. With factors u and w of a start, (u² − w²)/2 has about the distribution of the error of u w. So the error
that rollouts leave in a standard error is known (`simulation`). It is not the error of the policy: where that is far
from the agent's, values and errors are wrong together.
"""

from dataclasses import replace
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PRNGKeyArray

from sidestep._typing import FloatTree, Tree
from sidestep.continuous.dynamics import Dynamics
from sidestep.continuous.estimators import sample_surrogates
from sidestep.continuous.likelihood import ActionLikelihood, FitProblem
from sidestep.continuous.planner import PlannerState
from sidestep.continuous.policies import Agent, FinitePolicy, Starts
from sidestep.continuous.rollouts import q_estimates
from sidestep.continuous.tasks import task_at
from sidestep.errors import check, check_count
from sidestep.inference.information import Information, Simulation, Vectors
from sidestep.inference.normal_posterior import Laplace
from sidestep.inference.objective import Parameters
from sidestep.tabular.backups import BoltzmannAverage
from sidestep.tabular.behavior_model import BehaviorParameters

_ROLLOUTS = 2**13
"""The most rollouts at a time, for their memory."""


class _Halves(NamedTuple):
    """What the two halves of the rollouts say of some moves.

    `factors` are √π β (∇Q − Σ π ∇Q) of every candidate, `scores` the gradients of ln π of the observed choices.
    """

    factors: Float[Array | np.ndarray, "2 moves candidates parameters"]
    scores: Float[Array | np.ndarray, "2 moves parameters"]


class RolloutInformation(Information):
    """The information of a fit of continuous dynamics; made by `ContinuousFit.information`.

    Args:
        problem: The problem.
        dynamics: The family at θ.
        planner_state: The agent's policy and critic at θ.
        samples: Rollouts of each candidate action, 2 or more.
        seed: Draws everything random.
        message: How the fit ended.

    Raises:
        InputError: For the Boltzmann average with the actions' term: its gradient with the policy held fixed is not
            the gradient of a likelihood. For fewer than 2 samples.

    References:
        McCullagh and Nelder, "Generalized Linear Models" (1989), for observed and expected information.
    """

    farthest: ClassVar[float] = 0.5

    def __init__(
        self,
        problem: FitProblem,
        dynamics: Dynamics,
        planner_state: PlannerState[Any],
        *,
        samples: int,
        seed: int = 0,
        message: str = "",
    ):
        check_count(samples, 2, "samples")
        uses_actions = "actions" in problem.terms
        average = isinstance(problem.agent.behavior.backup, BoltzmannAverage)
        expected = "expected another backup: with the Boltzmann average the gradient is not that of a likelihood"
        check(not (uses_actions and average), expected, source="laplace", field="behavior")
        self.parameters: Parameters = Parameters(dynamics.parameters, BehaviorParameters())
        self.message: str = message
        self._problem = problem
        exact = np.asarray(ravel_pytree(_slope(problem, dynamics.parameters))[0], np.float64)
        halves = _halves(problem, dynamics, planner_state, samples, seed) if uses_actions else _nothing(len(exact))
        self._factors, self._scores = (np.asarray(part, np.float64) for part in halves)
        self.gradient: Float[np.ndarray, " parameters"] = self._scores.mean(axis=0).sum(axis=0) - exact

    def products(self, vectors: Vectors) -> Vectors:
        """Return H v of each vector, with the expected information of the actions.

        Args:
            vectors: One a row.
        """
        first, second = self._factors.reshape(2, -1, self.size)
        of_actions = (vectors @ first.T) @ second + (vectors @ second.T) @ first
        return _products(self._problem, self.parameters.model, vectors) + of_actions / 2

    def of_prior(self, vectors: Vectors) -> Vectors:
        """Return the products with the prior's part of H alone.

        Args:
            vectors: One a row.
        """
        return _products(replace(self._problem, terms=("actions",)), self.parameters.model, vectors)

    def simulation(self, normal: Laplace) -> Simulation:
        """Return the errors by rollouts.

        Args:
            normal: The normal distribution with this information.
        """
        variances = np.asarray(ravel_pytree(normal.standard_errors)[0], np.float64) ** 2
        flat = self._factors.reshape(-1, self.size)
        first, second = normal.covariance_products(flat).reshape(self._factors.shape) ** 2
        change = (first - second).sum(axis=1) / 2  # of each variance, by each move
        errors = np.sqrt((change**2).sum(axis=0)) / variances / 2
        noise = (self._scores[0] - self._scores[1]) / 2
        squared_distance = float(np.sum(noise * normal.covariance_products(noise)))
        return Simulation(float(errors.max(initial=0.0)), squared_distance)


def _nothing(size: int) -> _Halves:
    return _Halves(jnp.zeros((2, 0, 0, size)), jnp.zeros((2, 0, size)))


def _halves(
    problem: FitProblem, dynamics: Dynamics, planner_state: PlannerState[Any], samples: int, seed: int
) -> _Halves:
    """Return what both halves of the rollouts say of all moves, computed batch by batch."""
    agent = replace(problem.agent, dynamics=dynamics, policy=planner_state.policy)
    policy, count = agent.policy, len(problem.demonstrations)
    candidates = len(policy.actions) if isinstance(policy, FinitePolicy) else 1 + problem.planner.candidates
    size = min(count, max(1, _ROLLOUTS // (samples * candidates)))
    moves = np.resize(np.arange(count), (-(-count // size), size))  # the last batch is filled up with the first moves
    keys = jax.random.split(jax.random.key(seed), len(moves))
    parts = [
        _batch_halves(problem, agent, planner_state, key, jnp.asarray(batch), samples)
        for key, batch in zip(keys, moves, strict=True)
    ]
    return _Halves(*(np.concatenate(leaves, axis=1)[:, :count] for leaves in zip(*parts, strict=True)))


@eqx.filter_jit
def _batch_halves(
    problem: FitProblem,
    agent: Agent[Any],
    planner_state: PlannerState[Any],
    key: PRNGKeyArray,
    moves: Array,
    samples: int,
) -> _Halves:
    demos, planner = problem.demonstrations, problem.planner
    choice_key, rollout_key = jax.random.split(key)
    tasks, states, observed = task_at(demos.tasks, demos.task[moves]), demos.states[moves], demos.actions[moves]
    drawn, probabilities = planner.candidate_actions(choice_key, agent.policy, tasks, states)
    likelihood = ActionLikelihood(agent, Starts(tasks, states, drawn), observed)
    starts, _ = likelihood.candidates(probabilities)
    half = samples // 2

    def of_candidate(task: Tree, state: Array, choice: Array, key: PRNGKeyArray) -> tuple[Array, Array]:
        """Return ∇Q and Q of both halves of the rollouts."""
        start = Starts(jax.tree.map(lambda leaf: leaf[None], task), state[None], choice[None, None])
        size = {"horizon": planner.horizon, "samples": 2 * half}

        def means(parameters: FloatTree) -> tuple[Array, Array]:
            surrogates, rollouts = sample_surrogates(
                agent, parameters, start, key, planner_state.critic, problem.estimator, **size
            )
            return surrogates.reshape(2, half).mean(axis=1), q_estimates(rollouts)[..., 0].reshape(2, half).mean(axis=1)

        slopes, q = jax.jacrev(means, has_aux=True)(agent.dynamics.parameters)
        return jax.vmap(lambda slope: ravel_pytree(slope)[0])(slopes), q

    # the candidates of one start share their random numbers
    of_start = jax.vmap(of_candidate, (None, None, 0, None))
    keys = jax.random.split(rollout_key, len(moves))
    by_candidate = jax.vmap(of_start)(starts.tasks, starts.states, starts.choices, keys)
    slopes, q = (jnp.moveaxis(leaf, 2, 0) for leaf in by_candidate)  # the halves first
    pi = likelihood.probabilities(q.mean(axis=0))[..., None]
    # drawn choices have less spread than the policy, by the part that each has in their mean
    drawn_again = 0.0 if isinstance(agent.policy, FinitePolicy) else jnp.sum(pi**2, axis=1, keepdims=True)
    beyond = slopes - jnp.sum(pi * slopes, axis=2, keepdims=True)
    factors = agent.behavior.beta * jnp.sqrt(pi / (1 - drawn_again)) * beyond
    weights = jnp.stack([likelihood.weights(each) for each in q[::-1]])  # each half has the weights of the other
    return _Halves(factors, jnp.sum(weights[..., None] * slopes, axis=2))


@eqx.filter_jit
def _slope(problem: FitProblem, parameters: FloatTree) -> Tree:
    """Return the gradient of minus the transitions' term and the prior."""
    moves = jnp.arange(len(problem.demonstrations))
    return jax.grad(lambda parameters: problem.rollout_free_loss(parameters, moves)[0])(parameters)


def _products(problem: FitProblem, parameters: FloatTree, vectors: Vectors) -> Vectors:
    """Return the products of vectors with the information of transitions and prior."""
    flat, unravel = ravel_pytree(parameters)
    directions = jax.vmap(unravel)(jnp.asarray(vectors, flat.dtype))
    leaves = jax.tree.leaves(_slope_changes(problem, parameters, directions))
    return np.concatenate([np.asarray(leaf, np.float64).reshape(len(vectors), -1) for leaf in leaves], axis=1)


@eqx.filter_jit
def _slope_changes(problem: FitProblem, parameters: FloatTree, directions: Tree) -> Tree:
    return jax.vmap(jax.linearize(lambda each: _slope(problem, each), parameters)[1])(directions)
