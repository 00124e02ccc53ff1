"""Newton steps by noisy gradients of objectives in closed form: where they end, and when they stop."""

import numpy as np
import pytest

import sidestep.continuous as sc
from sidestep.continuous.refinement import Visit, refine
from sidestep.continuous.verification import Verification

TIGHT = sc.Schedule(distance_tolerance=0.5)


class Objective:
    """Gradients of an objective with noise; it counts them, and has the noise that was asked for.

    `information` is the expected one: the steps' noise is normal with its inverse as covariance, times noise².
    """

    def __init__(self, slope, information, *, least_noise: float | None = 0.0, seed=0, **figures):
        self.slope, self.information = slope, np.atleast_2d(information)
        self.random, self.least_noise, self.figures = np.random.default_rng(seed), least_noise, figures
        self.noises, self.places, self.steps = [], [], []

    def __call__(self, flat, state, noise):
        noise, size = max(noise, self.least_noise) if self.least_noise is not None else 0.0, len(flat)
        root, covariance = np.linalg.cholesky(self.information), np.linalg.inv(self.information)
        errors = noise * root @ self.random.normal(size=size)
        gradient = self.slope(flat) + errors
        step = covariance @ gradient
        squared = gradient @ step / size
        step = step * min(1.0, 2 / np.sqrt(squared)) if squared else step
        distance = np.sqrt(max(squared - noise**2, 0.0))
        figures = {"policy_gap": 0.0, "beyond_horizon": 0.0, "unfinished": 0.0} | self.figures
        self.noises.append(noise)
        self.places.append(flat)
        self.steps.append(step)
        numbers = gradient, np.abs(errors), covariance, step, float(distance), float(noise)
        return Visit(flat, state, Verification(*numbers, **figures, samples=8))


def refined(objective, start, schedule=TIGHT):
    first = objective(np.asarray(start, float), None, schedule.step_noise)
    return refine(first, objective, schedule)


QUADRATIC = np.array([[3.0, 1.0], [1.0, 2.0]])
MAXIMUM = np.array([1.0, -2.0])


def quadratic(flat):
    return QUADRATIC @ (MAXIMUM - flat)


def test_refine_without_noise_ends_at_the_maximum():
    last = refined(Objective(quadratic, QUADRATIC, least_noise=None), [0.3, -1.0])
    np.testing.assert_allclose(last.flat, MAXIMUM, atol=1e-12)
    assert last.verification.passes(TIGHT)


def test_refine_without_noise_and_with_twice_the_information_goes_half_the_way_again_and_again():
    """Twelve steps and the mean's own: (1/2)¹³ of the way is left."""
    last = refined(Objective(quadratic, 2 * QUADRATIC, least_noise=None), [1.2, -2.2])
    np.testing.assert_allclose(last.flat - MAXIMUM, [0.2 / 2**13, -0.2 / 2**13], atol=1e-12)


def test_refine_mean_of_steps_has_less_noise_than_each():
    """Eight steps with noise √8 / 4 have a mean with noise 1/4, in standard deviations."""
    ends = [refined(Objective(quadratic, QUADRATIC, seed=seed), [0.0, 0.0]) for seed in range(200)]
    away = np.array([last.flat - MAXIMUM for last in ends])
    squares = np.einsum("ni,ij,nj->n", away, QUADRATIC, away) / 2
    assert np.sqrt(squares.mean()) == pytest.approx(0.25, rel=0.15)
    assert np.mean([last.verification.passes(TIGHT) for last in ends]) > 0.95


def test_refine_verifies_with_the_noise_of_the_tolerance():
    objective = Objective(quadratic, QUADRATIC)
    refined(objective, [0.0, 0.0])
    assert objective.noises[-1] == TIGHT.noise_tolerance
    assert set(objective.noises[:-1]) == {TIGHT.step_noise}
    assert len(objective.noises) >= 12 + 8 + 1


def test_refine_noise_in_many_directions_moves_a_maximum_little():
    """Whole steps would have a root mean square of the noise, √8 / 4."""
    objective = Objective(lambda flat: -flat, np.eye(100))
    refined(objective, np.zeros(100))
    assert np.sqrt(np.mean(objective.places[1] ** 2)) < 0.25 * TIGHT.step_noise


def test_refine_signal_in_many_directions_is_followed():
    objective = Objective(lambda flat: -flat, np.eye(100))
    refined(objective, np.full(100, 1.9))
    assert np.sqrt(np.mean(objective.places[1] ** 2)) < 0.6 * 1.9


def test_refine_noise_alone_takes_back_few_steps():
    """Whole steps lead on from the place before; one that was taken back leads on from an earlier one."""
    kept = []
    for seed in range(40):
        objective = Objective(quadratic, QUADRATIC, seed=seed)
        refined(objective, [0.0, 0.0])
        kept += [
            np.allclose(at + step, to)
            for at, step, to in zip(objective.places[:10], objective.steps, objective.places[1:], strict=False)
        ]
    assert np.mean(kept) > 0.98


@pytest.mark.parametrize("count", [1, 2, 40])
def test_refine_steps_that_lead_away_by_more_than_noise_are_shortened(count):
    """The expected information is a quarter of the curvature: whole steps go three times as far to the other side."""
    objective = Objective(lambda flat: -4 * flat, np.eye(count), least_noise=0.05)
    last = refined(objective, np.full(count, 0.6), sc.Schedule(distance_tolerance=0.2))
    assert np.sqrt(np.mean(last.flat**2)) < 0.1


def shoulder(flat):
    """A small slope for a long way, where the expected information says that a maximum is near."""
    return np.clip(-flat, -0.7, None)


def test_refine_leaves_a_shoulder_that_single_gradients_do_not_see():
    ends = [refined(Objective(shoulder, [[1.0]], seed=seed), [4.0]) for seed in range(100)]
    passed = [last for last in ends if last.verification.passes(TIGHT)]
    assert len(passed) > 80
    assert np.mean([abs(last.flat[0]) > 1 for last in passed]) < 0.03


def test_refine_leaves_a_long_shoulder_in_one_of_two_directions():
    """Its slope is .65 deviations: .46 as a root mean square over both, which is within the tolerance."""

    def slope(flat):
        return np.array([np.clip(-flat[0], -0.65, None), -flat[1]])

    ends = [refined(Objective(slope, np.eye(2), seed=seed), [6.0, 0.0]) for seed in range(200)]
    passed = [last for last in ends if last.verification.passes(TIGHT)]
    assert len(passed) > 160
    assert np.mean([abs(last.flat[0]) > 1 for last in passed]) < 0.06


def test_refine_step_that_leads_away_is_taken_back_and_halved():
    """The expected information is a third of the curvature: whole steps double the distance, half ones halve it."""
    objective = Objective(lambda flat: -3 * flat, [[1.0]], least_noise=None)
    last = refined(objective, [0.5])
    assert abs(last.flat[0]) < 0.1
    assert last.verification.passes(TIGHT)


def test_refine_noise_that_hides_every_step_ends_at_once():
    objective = Objective(quadratic, QUADRATIC, least_noise=1.3)
    last = refined(objective, MAXIMUM)
    np.testing.assert_array_equal(last.flat, MAXIMUM)
    assert objective.noises == [1.3]
    assert not last.verification.passes(TIGHT)


def test_refine_large_distance_is_followed_through_noise():
    objective = Objective(quadratic, QUADRATIC, least_noise=1.3)
    last = refined(objective, MAXIMUM + 20)
    assert len(objective.noises) > 5
    assert np.abs(last.flat - MAXIMUM).max() < 10
    assert not last.verification.passes(TIGHT)


def test_refine_two_verifications_at_most_where_another_figure_fails():
    objective = Objective(quadratic, QUADRATIC, policy_gap=9.0)
    last = refined(objective, [0.0, 0.0])
    assert objective.noises.count(TIGHT.noise_tolerance) == 2
    assert not last.verification.passes(TIGHT)


def test_refine_ends_after_its_most_steps_and_is_verified_there():
    """A slope without an end."""
    objective = Objective(lambda flat: np.full_like(flat, 5.0), [[1.0]], least_noise=None)
    last = refined(objective, [0.0])
    assert len(objective.noises) == 1 + 24 + 1
    np.testing.assert_allclose(last.flat, [2.0 * 25])
    assert not last.verification.passes(TIGHT)


def test_refine_where_every_step_leads_away_ends_where_it_began():
    """The expected information is much less than the curvature: each step is 20,000 times as long as it should be."""
    objective = Objective(lambda flat: -np.clip(100 * flat, -90, 90), [[1e-4]], least_noise=None)
    last = refined(objective, [0.01])
    assert abs(last.flat[0]) < 0.02
    assert not last.verification.passes(TIGHT)
