"""Settings of fits and planners at the edges of their ranges, and what a verification says of its figures."""

import jax.numpy as jnp
import numpy as np
import pytest

import sidestep.continuous as sc
from sidestep.continuous.verification import Verification
from sidestep.errors import InputError

LEAST = {
    sc.Schedule: {"iterations": 2, "policy_warmup": 0, "batch_size": 1, "policy_steps": 1, "verification_samples": 8},
    sc.Planner: {"horizon": 1, "batch_size": 1, "samples": 2, "candidates": 1, "critic_width": 1, "critic_steps": 1},
}
POSITIVE = {
    sc.Schedule: ("learning_rate", "distance_tolerance", "policy_gap_tolerance"),
    sc.Planner: ("learning_rate", "critic_rate"),
}
COUNTS = [(kind, name, least) for kind, own in LEAST.items() for name, least in own.items()]
RATES = [(kind, name) for kind, own in POSITIVE.items() for name in own]


def made(kind, **settings):
    return kind(**({"horizon": 5} if kind is sc.Planner else {}) | settings)


@pytest.mark.parametrize(("kind", "name", "least"), COUNTS)
def test_counts_below_the_least_are_refused(kind, name, least):
    assert getattr(made(kind, **{name: least}), name) == least
    with pytest.raises(InputError, match=f"{name}.*at least {least}, found {least - 1}"):
        made(kind, **{name: least - 1})


@pytest.mark.parametrize(("kind", "name"), RATES)
def test_rates_and_tolerances_not_above_0_are_refused(kind, name):
    assert getattr(made(kind, **{name: 1e-9}), name) == 1e-9
    for wrong in (0.0, -1.0, np.nan):
        with pytest.raises(InputError, match=name):
            made(kind, **{name: wrong})


def test_schedule_falls_along_a_cosine_to_a_twentieth():
    schedule = sc.Schedule(iterations=40, learning_rate=0.2)
    at = np.arange(41)
    cosine = 0.05 + 0.95 * (1 + np.cos(np.pi * at / 40)) / 2
    np.testing.assert_allclose(np.asarray([schedule.rate()(k) for k in at]), 0.2 * cosine, rtol=1e-6)
    np.testing.assert_allclose([schedule.fraction(jnp.asarray(k)) for k in at], cosine, rtol=1e-6)


def test_schedule_tolerances_are_those_of_the_page():
    """A converged fit is half a posterior standard deviation from its maximum at most, and its policy .1 nats away."""
    schedule = sc.Schedule()
    assert (schedule.distance_tolerance, schedule.noise_tolerance, schedule.policy_gap_tolerance) == (0.5, 0.25, 0.1)
    # eight steps have a mean with the noise that is asked for
    assert schedule.step_noise / np.sqrt(8) == pytest.approx(schedule.noise_tolerance)


def figures(**changes):
    numbers = {"distance": 0.7, "noise": 0.3, "policy_gap": -0.09, "beyond_horizon": 0.05, "unfinished": 0.1}
    arrays = np.zeros(1), np.ones(1), np.ones((1, 1)), np.zeros(1)
    return Verification(*arrays, **(numbers | changes), samples=64)


SCHEDULE = sc.Schedule(distance_tolerance=0.75, policy_gap_tolerance=0.1)


@pytest.mark.parametrize(("changes", "passes"), [
    ({}, True),
    ({"distance": 0.75, "noise": 0.375}, True),
    ({"distance": 0.76}, False),
    ({"noise": 0.38}, False),
    ({"policy_gap": -0.11}, False),
    ({"policy_gap": 0.11}, False),
    ({"beyond_horizon": 0.11}, False),
    ({"beyond_horizon": -0.11}, False),
    ({"unfinished": 0.2}, False),
])  # fmt: skip
def test_verification_passes_where_all_figures_are_within_the_tolerances(changes, passes):
    assert figures(**changes).passes(SCHEDULE) is passes


def test_verification_message_has_the_figures_and_what_is_wrong():
    message = figures().message(SCHEDULE)
    assert message.startswith(
        "the maximum is 0.7 posterior standard deviations away (tolerance 0.75), with noise of 0.3"
    )
    assert (
        "(tolerance 0.38) by 64 independent rollouts of each action, and the policy gap is -0.09 (tolerance 0.1)"
        in message
    )
    assert "too short" not in message
    assert "values at its end would move the policy by -0.2" in figures(beyond_horizon=-0.2).message(SCHEDULE)
    assert "0.3 of the rollouts do not end their task" in figures(unfinished=0.3).message(SCHEDULE)
