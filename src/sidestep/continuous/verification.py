"""How far a fit of continuous dynamics is from its maximum, by rollouts that the fit has not used.

With g the gradient of the objective and H its expected information (`information`), both of independent rollouts, the
maximum is a Newton step H⁻¹ g away. In posterior standard deviations, as a root mean square over parameters, that is

    distance² = gᵀ H⁻¹ g / parameters.

Rollouts add noise to it. Its mean is known from the difference of their halves, and is subtracted. Rollouts are added
until the noise is small enough.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from sidestep.continuous.dynamics import Dynamics
from sidestep.continuous.halves import gather_halves
from sidestep.continuous.information import rollout_free_products, rollout_free_slope
from sidestep.continuous.likelihood import FitProblem, Schedule
from sidestep.continuous.planner import PlannerState

SAMPLES = 8
"""Rollouts of each candidate at a time."""
_UNFINISHED = 0.1
"""The largest share of rollouts that may end before their task does."""
_LONGEST = 2.0
"""The longest Newton step, in posterior standard deviations."""
_Vector = Float[np.ndarray, " parameters"]
_Matrix = Float[np.ndarray, "parameters parameters"]


class Verification(NamedTuple):
    """The state of a fit, by independent rollouts from all demonstrated moves.

    Attributes:
        gradient: That of the objective, with the entries of `ravel_pytree` of the parameters.
        standard_errors: Those of the gradient, by rollouts.
        covariance: The inverse of the information.
        step: The Newton step to the maximum, at most two posterior standard deviations long.
        distance: Its length in posterior standard deviations, a root mean square over parameters, less noise.
        noise: The standard deviation that rollouts give to this length.
        policy_gap: The mean over moves, in nats or units of reward.
        beyond_horizon: How far the values at the ends of rollouts would move the policy, in nats.
        unfinished: The share of rollouts that the horizon ends before their task does, discounted.
        samples: Rollouts of each candidate action of each move.
    """

    gradient: _Vector
    standard_errors: _Vector
    covariance: _Matrix
    step: _Vector
    distance: float
    noise: float
    policy_gap: float
    beyond_horizon: float
    unfinished: float
    samples: int

    def passes(self, schedule: Schedule) -> bool:
        """Return whether all figures are within the tolerances.

        Args:
            schedule: It has the tolerances.
        """
        near = self.distance <= schedule.distance_tolerance and self.noise <= schedule.noise_tolerance
        gaps = max(abs(self.policy_gap), abs(self.beyond_horizon)) <= schedule.policy_gap_tolerance
        return bool(near and gaps and self.unfinished <= _UNFINISHED)

    def message(self, schedule: Schedule) -> str:
        """Return the figures in words.

        Args:
            schedule: It has the tolerances.
        """
        text = (
            f"the maximum is {self.distance:.2g} posterior standard deviations away (tolerance "
            f"{schedule.distance_tolerance:.2g}), with noise of {self.noise:.2g} (tolerance "
            f"{schedule.noise_tolerance:.2g}) by {self.samples} independent rollouts of each action, and the policy "
            f"gap is {self.policy_gap:.2g} (tolerance {schedule.policy_gap_tolerance:g})"
        )
        if abs(self.beyond_horizon) > schedule.policy_gap_tolerance:
            text += f"; the horizon is too short: values at its end would move the policy by {self.beyond_horizon:.2g}"
        if self.unfinished > _UNFINISHED:
            text += f"; the horizon is too short: {self.unfinished:.2g} of the rollouts do not end their task within it"
        return text


def verify(
    problem: FitProblem,
    dynamics: Dynamics,
    planner_state: PlannerState[Any],
    key: PRNGKeyArray,
    *,
    noise: float,
) -> Verification:
    """Return how far a fit is from its maximum, by as many rollouts as make the noise small enough.

    It computes the whole information, with the square of the number of parameters of entries.

    Args:
        problem: Demonstrations, prior and settings.
        dynamics: The family at θ.
        planner_state: The agent's policy and critic at θ.
        key: Draws everything random.
        noise: Where the noise of the distance is below it, no more rollouts are taken.
    """
    exact = -rollout_free_slope(problem, dynamics.parameters)
    known = rollout_free_products(problem, dynamics.parameters, np.eye(len(exact)))
    if "actions" not in problem.terms:
        return _verification(exact, known, known, np.zeros((0, len(exact))), np.zeros(3), 0)
    total_weight = float(np.asarray(problem.demonstrations.weights, np.float64).sum())
    total, scores, figures, rounds = np.zeros_like(known), np.zeros_like(exact), np.zeros(3), 0
    differences: list[np.ndarray] = []
    while True:
        for halves in gather_halves(problem, dynamics, planner_state, SAMPLES, jax.random.fold_in(key, rounds)):
            first, second = halves.factors.reshape(2, -1, len(exact))
            total += (first.T @ second + second.T @ first) / 2
            scores += halves.scores.mean(axis=0).sum(axis=0)
            differences.append(np.asarray(halves.scores[0] - halves.scores[1]) / 2)
            figures += np.concatenate(halves[2:]).sum(axis=1) / total_weight
        rounds += 1
        by_rollouts = exact + scores / rounds, known + total / rounds, known, np.concatenate(differences) / rounds
        result = _verification(*by_rollouts, figures / rounds, rounds * SAMPLES)
        if result.noise <= noise or result.samples + SAMPLES > problem.schedule.verification_samples:
            return result


def _verification(
    gradient: _Vector, information: _Matrix, known: _Matrix, noise: np.ndarray, figures: np.ndarray, samples: int
) -> Verification:
    """Return the figures; the outer products of the rows of `noise` add up to its covariance."""
    covariance = _covariance(information, known)
    step = covariance @ gradient
    squared, of_noise = gradient @ step / len(step), np.sum((noise @ covariance) * noise) / len(step)
    length = np.sqrt(max(squared, 0.0))
    gap, beyond, unfinished = map(float, figures)
    return Verification(
        gradient,
        np.sqrt((noise**2).sum(axis=0)),
        covariance,
        step * min(1.0, _LONGEST / length) if length > 0 else step,
        float(np.sqrt(max(squared - of_noise, 0.0))),
        float(np.sqrt(of_noise)),
        gap,
        beyond,
        unfinished,
        samples,
    )


def _covariance(information: _Matrix, known: _Matrix) -> _Matrix:
    """Return the inverse of the information, of which a part is known; noise must not take away from that part."""
    information, known = (information + information.T) / 2, (known + known.T) / 2
    diagonal = np.maximum(np.diag(information), np.diag(known))
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(scale[:, None] * information * scale)
    least = np.sum(vectors * ((scale[:, None] * known * scale) @ vectors), axis=0)
    values = np.maximum(np.maximum(values, least), np.finfo(np.float64).eps)
    return scale[:, None] * ((vectors / values) @ vectors.T) * scale
