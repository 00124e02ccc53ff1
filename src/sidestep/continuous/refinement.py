"""The end of a fit by rollouts: Newton steps by large batches until they lead nowhere, and a verification.

With g the gradient of the objective by rollouts from all demonstrated moves, and H the expected information, a step
goes from θ to θ + H⁻¹ g, with rollouts of its own (`verify`). Where the mean gradient of the last steps is near 0, the
mean of the places that they lead to is the result (Polyak and Juditsky 1992). It is verified by independent rollouts.

This differs from the textbook in three points. Steps have their whole length instead of one that falls, because their
drift tells a maximum from a shoulder: there the objective is flatter than the expected information says, and the
gradient of one batch is lost in its noise. A step that clearly leads away from the maximum is taken back, and the
next ones have half its length. The policy follows θ before each step.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from sidestep.continuous.likelihood import Schedule
from sidestep.continuous.planner import PlannerState
from sidestep.continuous.verification import Verification

_STEPS = 24
"""The most steps."""
_FIRST = 12
"""The steps before those of which a mean counts: they lead along a shoulder, and away from where they start."""
_FARTHER = 3.0
"""By how many standard deviations the squared distance may grow with a step that is not taken back."""
_VERIFICATIONS = 2
"""The most verifications of a mean; steps go on from the first that fails."""
_NEAR = 0.25
"""The largest distance of a mean that is verified, as a part of the tolerance."""


class Visit(NamedTuple):
    """A place where the gradient was taken: θ as one vector, policy and critic, and the gradient with its figures."""

    flat: np.ndarray
    planner_state: PlannerState[Any]
    verification: Verification


Visitor = Callable[[np.ndarray, PlannerState[Any], float], Visit]
"""Takes the gradient at θ, by as many rollouts as reach a noise, after the policy has followed θ."""


def refine(first: Visit, visit: Visitor, schedule: Schedule) -> Visit:
    """Return a place where Newton steps lead nowhere, verified by independent rollouts.

    Args:
        first: Where to start.
        visit: Takes the gradient at a place.
        schedule: It has the tolerances.

    References:
        Polyak and Juditsky, "Acceleration of stochastic approximation by averaging" (1992); James and Stein,
        "Estimation with quadratic loss" (1961).
    """
    visits, length, verified = [first], 1.0, 0
    for _ in range(_STEPS):
        recent = _averaged(visits[_FIRST:], schedule)
        if recent and _mean_distance(recent) <= _NEAR * schedule.distance_tolerance:
            mean, verified = _at_mean(recent, length, visit, schedule), verified + 1
            if verified == _VERIFICATIONS or mean.verification.passes(schedule):
                return mean
            visits.append(mean)
        current = visits[-1]
        if _noise_hides_steps(current.verification, schedule):
            return current
        step = length * _signal(current.verification) * current.verification.step
        after = visit(current.flat + step, current.planner_state, schedule.step_noise)
        if _leads_away(after.verification, current.verification):
            length /= 2
        else:
            visits.append(after)
    return _at_mean(_averaged(visits[_FIRST:], schedule) or visits[-1:], length, visit, schedule)


def _averaged(visits: Sequence[Visit], schedule: Schedule) -> Sequence[Visit]:
    """Return the fewest last visits with a mean gradient of a noise within the tolerance; none where all have more."""
    squares = np.cumsum([each.verification.noise**2 for each in reversed(visits)])
    within = np.sqrt(squares) / np.arange(1, len(visits) + 1) <= schedule.noise_tolerance
    return visits[-1 - int(within.argmax()) :] if within.any() else []


def _mean_distance(visits: Sequence[Visit]) -> float:
    """Return the length of the Newton step by the mean gradient, in posterior standard deviations, less noise."""
    gradient = np.mean([each.verification.gradient for each in visits], axis=0)
    covariance = np.mean([each.verification.covariance for each in visits], axis=0)
    noise = np.sum([each.verification.noise**2 for each in visits]) / len(visits) ** 2
    return float(np.sqrt(max(gradient @ covariance @ gradient / len(gradient) - noise, 0.0)))


def _at_mean(visits: Sequence[Visit], length: float, visit: Visitor, schedule: Schedule) -> Visit:
    """Return a visit of the mean of the places that steps lead to, with as little noise as the tolerance asks for."""
    target = np.mean([each.flat + length * each.verification.step for each in visits], axis=0)
    return visit(target, visits[-1].planner_state, schedule.noise_tolerance)


def _noise_hides_steps(last: Verification, schedule: Schedule) -> bool:
    """Return whether the distance is within a noise that no number of steps brings within the tolerance."""
    return bool(last.noise > np.sqrt(_STEPS) * schedule.noise_tolerance and last.distance <= last.noise)


def _signal(last: Verification) -> float:
    """Return the part of a step that is not noise, by James and Stein; 1 for up to two parameters."""
    squares = last.distance**2 + last.noise**2
    return 1.0 if squares == 0 else 1 - max(0.0, 1 - 2 / len(last.step)) * last.noise**2 / squares


def _leads_away(after: Verification, before: Verification) -> bool:
    """Return whether a step leads away from the maximum, by more than the noise of step and distance explains."""
    parameters = len(after.step)
    noise = after.noise**2 * np.sqrt(2 / parameters) + 2 * after.distance * after.noise / np.sqrt(parameters)
    return bool(after.distance**2 > before.distance**2 + before.noise**2 + _FARTHER * noise)
