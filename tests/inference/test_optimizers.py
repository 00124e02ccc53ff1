"""The optimizers on functions with a known minimum."""

from itertools import pairwise

import numpy as np
import pytest

from sidestep.inference.optimizers import LBFGS, Adam, Rprop

CURVATURE = np.array([1.0, 10.0, 100.0])
MINIMUM = np.array([1.0, -2.0, 0.5])


def quadratic(x):
    return float(0.5 * CURVATURE @ (x - MINIMUM) ** 2), CURVATURE * (x - MINIMUM)


def rosenbrock(x):
    """The minimum is at (1, 1)."""
    value = (1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2
    slope = np.array([-2 * (1 - x[0]) - 400 * x[0] * (x[1] - x[0] ** 2), 200 * (x[1] - x[0] ** 2)])
    return float(value), slope


def cliff(x):
    """The minimum is at 1; from 1.2 on there are no values."""
    return (np.inf, np.full_like(x, np.nan)) if x[0] >= 1.2 else (float((x[0] - 1) ** 2), 2 * (x - 1))


def exactly(function):
    """A loss without approximations."""

    def loss(x, *, approximate=False):
        del approximate
        return function(x)

    return loss


def run(optimizer, function, start, steps):
    """The points and values on the way."""
    x = np.asarray(start, dtype=float)
    state = optimizer.init(x)
    way = [(x, function(x)[0])]
    for _ in range(steps):
        value, slope = function(x)
        after = optimizer.step(exactly(function), x, value, slope, state)
        if after is None:
            break
        x, state = after
        way.append((x, function(x)[0]))
    return way


def step(optimizer, loss, x, state=None):
    """A step that finds a better point, the first one without a state."""
    after = optimizer.step(loss, x, *loss(x), optimizer.init(x) if state is None else state)
    assert after is not None
    return after


def test_rprop_keeps_the_dtype_of_the_start():
    def in_32_bit(x):
        return quadratic(x)[0], quadratic(x)[1].astype(np.float32)

    x, state = np.full(3, 4.0, dtype=np.float32), None
    for _ in range(3):
        x, state = step(Rprop(), exactly(in_32_bit), x, state)
        assert (x.dtype, state.dtype) == (np.float32, np.float32)


@pytest.mark.parametrize(("function", "start", "minimum", "steps"), [
    (quadratic, [5.0, 5.0, 5.0], MINIMUM, 30),
    (rosenbrock, [-1.2, 1.0], [1, 1], 60),
    (cliff, [-40.0], [1], 30),
])  # fmt: skip
def test_lbfgs_decreases_the_loss_down_to_the_minimum(function, start, minimum, steps):
    way = run(LBFGS(), function, start, steps)
    values = [value for _, value in way]
    assert all(after < before for before, after in pairwise(values))
    np.testing.assert_allclose(way[-1][0], minimum, atol=1e-5)


def test_lbfgs_step_without_a_better_point_returns_none():
    assert LBFGS().step(exactly(quadratic), MINIMUM, *quadratic(MINIMUM), LBFGS().init(MINIMUM)) is None
    pit = np.zeros(1)
    ridge = exactly(lambda x: (float(np.abs(x).sum()), np.ones(1)))
    assert LBFGS().step(ridge, pit, 0.0, np.ones(1), LBFGS().init(pit)) is None


def test_lbfgs_keeps_the_dtype_of_the_start():
    """In a ravine so narrow that the first step is too long, and the search has to come back."""
    calls = []

    def ravine(x):
        calls.append(x.dtype)
        return float(np.sum((100 * x) ** 4)), (400 * (100 * x) ** 3).astype(np.float32)

    after = step(LBFGS(), exactly(ravine), np.array([0.05, 0.03], dtype=np.float32))
    assert after[0].dtype == np.float32
    assert set(calls) == {np.dtype(np.float32)}
    assert len(calls) > 3


@pytest.mark.slow
def test_adam_reaches_the_minimum():
    way = run(Adam(max_iterations=300, learning_rate=0.1), quadratic, [2.0, 0.0, 0.0], 300)
    np.testing.assert_allclose(way[-1][0], MINIMUM, atol=1e-3)


def test_adam_steps_decrease_along_a_cosine():
    """On an even slope each step of Adam is as long as the learning rate."""
    way = run(Adam(max_iterations=100, learning_rate=0.1), lambda x: (float(x[0]), np.ones(1)), [0.0], 100)
    lengths = [float((before - after)[0]) for (before, _), (after, _) in pairwise(way)]
    expected = 0.05 * (1 + np.cos(np.pi * np.arange(100) / 100))
    np.testing.assert_allclose(lengths, expected, atol=1e-6)


HEIGHTS = np.array([0.5, 2.0, 6.0, 7.0])


def cliffs(x):
    """Rises gently with the distance from 0, and steeply, by thousands, below a height of its own in each direction.

    The edges are so sharp that at the minimum the slope would have to be known to a billionth of a unit.
    """
    below = 1e6 * (HEIGHTS - x)
    value = np.sum(x**2 / 8) + np.sum(5e-3 * np.logaddexp(0, below))
    odds = np.exp(np.minimum(below, 0)) / (1 + np.exp(-np.abs(below)))
    return float(value), x / 4 - 5e3 * odds


def test_rprop_stops_at_the_edge_of_cliffs():
    optimizer = Rprop(tolerance=1e-3)
    x, state, calls = np.full(4, 9.0), optimizer.init(np.full(4, 9.0)), []

    def evaluate(x):
        calls.append(x)
        return cliffs(x)

    for _ in range(100):
        if optimizer.terminate(cliffs(x)[1], state):
            break
        before = cliffs(x)[0]
        x, state = step(optimizer, exactly(evaluate), x, state)
        assert cliffs(x)[0] < before
        # none that was taken has fallen deep below an edge
        assert (x > HEIGHTS - 0.01).all()
    assert optimizer.terminate(cliffs(x)[1], state)
    np.testing.assert_allclose(x, HEIGHTS, atol=2e-3)
    assert len(calls) < 200


def test_rprop_after_a_failed_trial_keeps_its_step_size():
    """Where there are no values the trial is shorter, but the next step is as long as before."""
    after = step(Rprop(initial_step=1.0), exactly(lambda x: cliff(x + 40.5)), np.array([-40.0]))
    np.testing.assert_allclose(after, ([-39.75], [1.4]))


def test_rprop_holds_back_only_parameters_that_overshoot():
    """A second parameter's cliff does not hold up the first one."""

    def evaluate(x):
        return float(x @ x / 8 + 1e3 * max(2.0 - x[1], 0)), np.array([x[0] / 4, x[1] / 4 - 1e3 * (x[1] < 2.0)])

    after = step(Rprop(initial_step=1.0), exactly(evaluate), np.array([5.0, 2.2]))
    np.testing.assert_array_equal(after[0], [4.0, 2.2])
    np.testing.assert_allclose(after[1], [1.4, 0.25])


def test_rprop_confirms_approximate_losses():
    """Approximate losses omit the second parameter's cliff, and each acceptable one is confirmed."""
    calls = []

    def evaluate(x, *, approximate=False):
        calls.append(approximate)
        below = np.array([0.0, not approximate and x[1] < 2.0 and x[2] >= 2.0, x[2] < 2.0])
        return float(x @ x / 8 + 1e3 * below @ np.maximum(2.0 - x, 0)), x / 4 - 1e3 * below

    after = step(Rprop(initial_step=1.0), evaluate, np.array([5.0, 2.2, 2.2]))
    np.testing.assert_array_equal(after[0], [4.0, 2.2, 2.2])
    # the start; all three, which meets the third one's cliff; without it, twice; without the second one, twice
    assert calls == [False, False, True, False, True, False]


def test_rprop_shorter_trial_is_not_approximate():
    """Beyond .5 is a plateau. Its gradient does not show it, so approximate losses would not show that it is left."""
    beyond = [False]

    def evaluate(x, *, approximate=False):
        if not approximate:
            beyond[0] = bool(x[0] > 0.5)
        return float(1e3 * beyond[0] - x[0]), np.array([-1.0])

    after = step(Rprop(initial_step=1.0), evaluate, np.array([0.0]))
    np.testing.assert_array_equal(after[0], [0.25])


def test_rprop_on_a_steeper_slope_grows_by_four():
    """Where a slope becomes steeper on the way, the next step is four times as long."""

    def evaluate(x):
        return float(-np.exp(x[0])), -np.exp(x)

    after = step(Rprop(initial_step=0.01), exactly(evaluate), np.array([0.0]))
    np.testing.assert_allclose(after, ([0.01], [0.04]))


def test_rprop_step_without_a_better_point_returns_none():
    pit = np.zeros(2)
    optimizer = Rprop()
    ridge = exactly(lambda x: (float(np.abs(x).sum()), np.ones(2)))
    assert optimizer.step(ridge, pit, 0.0, np.ones(2), optimizer.init(pit)) is None
    assert optimizer.step(exactly(quadratic), MINIMUM, *quadratic(MINIMUM), optimizer.init(MINIMUM)) is None


def test_terminate_compares_the_convergence_measure_with_the_tolerance():
    gradient, sizes = np.array([0.5, -2.0]), np.array([1.0, 0.1])
    for optimizer in (LBFGS, Adam):
        assert optimizer().convergence(gradient, None) == 2.0
        assert [optimizer(tolerance=tolerance).terminate(gradient, None) for tolerance in (1.9, 2.0)] == [False, True]
    assert Rprop().convergence(gradient, sizes) == pytest.approx(0.7)
    assert [Rprop(tolerance=tolerance).terminate(gradient, sizes) for tolerance in (0.69, 0.71)] == [False, True]


@pytest.mark.parametrize(("one", "other", "same"), [
    (LBFGS(), LBFGS(max_iterations=7, tolerance=1.0), True),
    (LBFGS(), LBFGS(memory_size=3), False),
    (Adam(), Adam(tolerance=1.0), True),
    (Adam(), Adam(max_iterations=7), False),
    (Adam(), Adam(learning_rate=0.1), False),
    (LBFGS(), Adam(), False),
    (Rprop(), Rprop(max_iterations=7, tolerance=2.0), True),
    (Rprop(), Rprop(initial_step=0.1), False),
])  # fmt: skip
def test_key_has_what_a_resumed_fit_must_share(one, other, same):
    assert (one.key == other.key) == same
