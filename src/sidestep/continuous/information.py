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
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from sidestep._typing import FloatTree, Tree
from sidestep.continuous.dynamics import Dynamics
from sidestep.continuous.halves import gather_halves
from sidestep.continuous.likelihood import FitProblem
from sidestep.continuous.planner import PlannerState
from sidestep.errors import check, check_count
from sidestep.inference.information import Information, Simulation, Vectors
from sidestep.inference.normal_posterior import Laplace
from sidestep.inference.objective import Parameters
from sidestep.tabular.backups import BoltzmannAverage
from sidestep.tabular.behavior_model import BehaviorParameters


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
        exact = rollout_free_slope(problem, dynamics.parameters)
        data = problem, dynamics, planner_state, samples, seed
        halves = _factors_and_scores(*data) if uses_actions else _nothing(len(exact))
        self._factors, self._scores = (np.asarray(part, np.float64) for part in halves)
        self.gradient: Float[np.ndarray, " parameters"] = self._scores.mean(axis=0).sum(axis=0) - exact

    def products(self, vectors: Vectors) -> Vectors:
        """Return H v of each vector, with the expected information of the actions.

        Args:
            vectors: One a row.
        """
        first, second = self._factors.reshape(2, -1, self.size)
        of_actions = (vectors @ first.T) @ second + (vectors @ second.T) @ first
        return rollout_free_products(self._problem, self.parameters.model, vectors) + of_actions / 2

    def of_prior(self, vectors: Vectors) -> Vectors:
        """Return the products with the prior's part of H alone.

        Args:
            vectors: One a row.
        """
        return rollout_free_products(replace(self._problem, terms=("actions",)), self.parameters.model, vectors)

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


def _nothing(size: int) -> tuple[Array, Array]:
    return jnp.zeros((2, 0, 0, size)), jnp.zeros((2, 0, size))


def _factors_and_scores(
    problem: FitProblem, dynamics: Dynamics, planner_state: PlannerState[Any], samples: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    batches = list(gather_halves(problem, dynamics, planner_state, samples, jax.random.key(seed)))
    factors, scores = (np.concatenate(parts, axis=1) for parts in zip(*(each[:2] for each in batches), strict=True))
    return factors, scores


def rollout_free_slope(problem: FitProblem, parameters: FloatTree) -> Float[np.ndarray, " parameters"]:
    """Return the gradient of minus the transitions' term and the prior.

    Args:
        problem: The problem.
        parameters: θ.
    """
    return np.asarray(ravel_pytree(_slope(problem, parameters))[0], np.float64)


@eqx.filter_jit
def _slope(problem: FitProblem, parameters: FloatTree) -> Tree:
    """Return the gradient of minus the transitions' term and the prior."""
    moves = jnp.arange(len(problem.demonstrations))
    return jax.grad(lambda parameters: problem.rollout_free_loss(parameters, moves)[0])(parameters)


def rollout_free_products(problem: FitProblem, parameters: FloatTree, vectors: Vectors) -> Vectors:
    """Return the products of vectors with the information of transitions and prior.

    Args:
        problem: The problem.
        parameters: θ.
        vectors: One a row.
    """
    flat, unravel = ravel_pytree(parameters)
    directions = jax.vmap(unravel)(jnp.asarray(vectors, flat.dtype))
    leaves = jax.tree.leaves(_slope_changes(problem, parameters, directions))
    return np.concatenate([np.asarray(leaf, np.float64).reshape(len(vectors), -1) for leaf in leaves], axis=1)


@eqx.filter_jit
def _slope_changes(problem: FitProblem, parameters: FloatTree, directions: Tree) -> Tree:
    return jax.vmap(jax.linearize(lambda each: _slope(problem, each), parameters)[1])(directions)
