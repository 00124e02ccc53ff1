"""A fit by rollouts beside values on a lattice, which are exact but for its spacing; for up to three dimensions.

The lattice has the objective and its gradient without rollouts, policies or critics: values by value iteration, their
derivatives by the implicit function theorem. An outcome leads to the points within four standard deviations of it, in
proportion to its normal density there. A sum over equally spaced points is so close to the integral of a normal density
that a spacing of 1.5 standard deviations has its mean and variance to three digits (Goodwin 1949).
"""

from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from sidestep._typing import FloatTree
from sidestep.continuous.dynamics import GaussianDynamics, Vector
from sidestep.continuous.fit import ContinuousFit
from sidestep.continuous.information import rollout_free_slope
from sidestep.continuous.lattice import Lattice, LatticePlanner
from sidestep.continuous.policies import FinitePolicy
from sidestep.continuous.tasks import ContinuousTask, task_at
from sidestep.errors import NotConverged, check, check_instance
from sidestep.tabular.solve import check_proper, solve

_DIMENSIONS = 3
"""The most dimensions of a lattice here."""
_REACH = 4
"""How many standard deviations the noise of an outcome reaches; with 3, gradients would be 3 % too small."""
_Numbers = Float[np.ndarray, " parameters"]


class LatticeComparison(NamedTuple):
    """A fit beside a lattice; vectors have the entries of `ravel_pytree` of the parameters.

    Attributes:
        log_likelihood: That of the actions at the learned θ, in nats.
        gradient: That of the objective at the learned θ.
        errors: How far the gradient by rollouts is from it, in standard errors of the rollouts.
        step: The Newton step to the maximum, with the information of the fit's verification.
        distance: Its length in posterior standard deviations, a root mean square over parameters.
    """

    log_likelihood: float
    gradient: _Numbers
    errors: _Numbers
    step: _Numbers
    distance: float


class NoisyPlanner(LatticePlanner):
    """An agent that plans on a lattice with the noise of its dynamics.

    Attributes:
        reach: The number of points on either side of an outcome, along each side of the lattice, that its noise
            reaches.
    """

    reach: tuple[int, ...] = eqx.field(static=True)

    def landing(self, mean: Vector) -> tuple[Int[Array, " landing"], Float[Array, " landing"]]:
        """Return the points around an outcome, with probabilities as its normal density has them.

        Args:
            mean: The mean next state of the outcome.
        """
        lattice = self.lattice
        counts, rings = jnp.asarray(lattice.counts), jnp.asarray(lattice.periodic)
        position, spread = (mean - lattice.low) / lattice.spacing, self.dynamics.noise / lattice.spacing
        # places beyond the border count as on it; the noise goes inwards from there
        position = jnp.where(rings, position, jnp.clip(position, 0, counts - 1))
        offsets = jnp.asarray(list(product(*(range(-far, far + 1) for far in self.reach))))
        points = jnp.round(jax.lax.stop_gradient(position)).astype(jnp.int32) + offsets
        weights = jax.nn.softmax(-jnp.sum(((points - position) / spread) ** 2, axis=1) / 2)
        points = jnp.where(rings, points % counts, jnp.clip(points, 0, counts - 1))
        strides = jnp.asarray(np.append(np.cumprod(lattice.counts[:0:-1])[::-1], 1).astype(np.int32))
        return points @ strides, weights


def compare_with_lattice(fit: ContinuousFit[Any, Any], lattice: Lattice) -> LatticeComparison:
    """Compare a fit with the exact objective on a lattice, at the learned parameters.

    Agents of the lattice look ahead without end, so that a horizon that is too short is seen, too.

    Args:
        fit: The fit, with the actions' term, Gaussian dynamics and a finite set of actions.
        lattice: Of one to three dimensions, around all places where the agents may go. Its spacing is at most 1.5 times
            the noise of the dynamics.

    Returns:
        The objective's gradient, and the distance of θ from the maximum that it implies.

    Raises:
        InputError: For another kind of fit, or a lattice that is too coarse or has other dimensions than the states.
        ImproperTask: For a task with infinite values.
        NotConverged: For values on the lattice that did not converge.

    References:
        Goodwin, "The evaluation of integrals of the form ∫ f(x) e^(−x²) dx" (1949), for sums in place of integrals.
    """
    check_instance(fit, ContinuousFit, "fit")
    check_instance(lattice, Lattice, "lattice")
    problem, dynamics = fit.problem, fit.dynamics
    policy, demos = problem.agent.policy, problem.demonstrations
    known = isinstance(dynamics, GaussianDynamics) and isinstance(policy, FinitePolicy)
    kinds = f"{type(dynamics).__name__} and {type(policy).__name__}"
    check(known, f"expected Gaussian dynamics and a finite set of actions, found {kinds}", field="fit")
    check("actions" in problem.terms, f"expected a fit with the actions' term, found {problem.terms}", field="terms")
    dimensions = len(lattice.counts)
    message = f"expected {demos.states.shape[-1]} dimensions, at most {_DIMENSIONS}, found {dimensions}"
    check(dimensions == demos.states.shape[-1] and dimensions <= _DIMENSIONS, message, field="lattice")
    lattice.check_inside(demos.states, "lattice")
    ratio = np.asarray(dynamics.noise / lattice.spacing, np.float64)
    message = f"expected a spacing of at most 1.5 times the noise {dynamics.noise}, found {lattice.spacing}"
    check((ratio >= 1 / 1.5).all(), message, field="lattice")
    reach = tuple(int(count) for count in np.ceil(_REACH * ratio))
    planner = NoisyPlanner(dynamics, policy.actions, problem.agent.behavior, lattice, reach)
    world = planner.tabular_model().graph
    total, slope = 0.0, -rollout_free_slope(problem, dynamics.parameters)
    for index in np.unique(np.asarray(demos.task)):
        own = np.flatnonzero(np.asarray(demos.task) == index)
        task = task_at(demos.tasks, int(index))
        check_proper(planner.tabular_task(task), planner.behavior, world)
        value, gradient, converged = _log_likelihood(
            dynamics.parameters, planner, task, demos.states[own], demos.actions[own], demos.weights[own]
        )
        if not converged:
            raise NotConverged(f"values on the lattice did not converge for task {index}")
        total, slope = total + float(value), slope + np.asarray(ravel_pytree(gradient)[0], np.float64)
    rolled = fit.verification
    step = rolled.covariance @ slope
    errors = (rolled.gradient - slope) / rolled.standard_errors
    return LatticeComparison(total, slope, errors, step, float(np.sqrt(slope @ step / len(step))))


@eqx.filter_jit
def _log_likelihood(
    parameters: FloatTree, planner: LatticePlanner, task: ContinuousTask, states: Array, actions: Array, weights: Array
) -> tuple[Array, FloatTree, Array]:
    """Return the log-likelihood of some actions, its gradient, and whether the values converged."""

    def total(parameters: FloatTree) -> tuple[Array, Array]:
        moved = replace(planner, dynamics=planner.dynamics.with_parameters(parameters))
        solution = solve(moved.tabular_model(), moved.tabular_task(task), moved.behavior)
        q = jax.vmap(lambda state: moved.action_values(task, solution.values, state))(states)
        log_probs = jnp.take_along_axis(moved.behavior.log_policy(q), actions[:, None], axis=1)[:, 0]
        return jnp.sum(weights.astype(log_probs.dtype) * log_probs), solution.converged

    (value, converged), gradient = jax.value_and_grad(total, has_aux=True)(parameters)
    return value, gradient, converged
