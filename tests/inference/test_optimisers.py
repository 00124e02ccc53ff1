"""The optimisers on functions whose lowest point is known."""

from itertools import pairwise

import numpy as np
import pytest

from sidestep.inference.optimisers import LBFGS, Ascent

CURVATURE = np.array([1.0, 10.0, 100.0])
LOWEST = np.array([1.0, -2.0, 0.5])


def bowl(x):
    return float(0.5 * CURVATURE @ (x - LOWEST) ** 2), CURVATURE * (x - LOWEST)


def banana(x):
    """Rosenbrock's valley, lowest at (1, 1)."""
    value = (1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2
    slope = np.array([-2 * (1 - x[0]) - 400 * x[0] * (x[1] - x[0] ** 2), 200 * (x[1] - x[0] ** 2)])
    return float(value), slope


def cliff(x):
    """Falls towards 1, and has no values from 1.2 on."""
    return (np.inf, np.full_like(x, np.nan)) if x[0] >= 1.2 else (float((x[0] - 1) ** 2), 2 * (x - 1))


def run(optimiser, function, start, steps):
    """The points and values on the way."""
    x = np.asarray(start, dtype=float)
    state = optimiser.init(x)
    way = [(x, function(x)[0])]
    for _ in range(steps):
        value, slope = function(x)
        after = optimiser.step(function, x, value, slope, state)
        if after is None:
            break
        x, state = after
        way.append((x, function(x)[0]))
    return way


@pytest.mark.parametrize(("function", "start", "lowest", "steps"), [
    (bowl, [5.0, 5.0, 5.0], LOWEST, 30),
    (banana, [-1.2, 1.0], [1, 1], 60),
    (cliff, [-40.0], [1], 30),
])  # fmt: skip
def test_lbfgs_goes_downhill_to_the_lowest_point(function, start, lowest, steps):
    way = run(LBFGS(), function, start, steps)
    values = [value for _, value in way]
    assert all(after < before for before, after in pairwise(values))
    np.testing.assert_allclose(way[-1][0], lowest, atol=1e-5)


def test_lbfgs_says_where_nothing_can_be_gained():
    assert LBFGS().step(bowl, LOWEST, *bowl(LOWEST), LBFGS().init(LOWEST)) is None
    pit = np.zeros(1)
    assert LBFGS().step(lambda x: (float(np.abs(x).sum()), np.ones(1)), pit, 0.0, np.ones(1), LBFGS().init(pit)) is None


def test_points_have_the_dtype_of_the_start():
    """In a ravine so narrow that the first step is too long, and the search has to come back."""
    asked = []

    def ravine(x):
        asked.append(x.dtype)
        return float(np.sum((100 * x) ** 4)), (400 * (100 * x) ** 3).astype(np.float32)

    x = np.array([0.05, 0.03], dtype=np.float32)
    after = LBFGS().step(ravine, x, *ravine(x), LBFGS().init(x))
    assert after is not None
    assert after[0].dtype == np.float32
    assert set(asked) == {np.dtype(np.float32)}
    assert len(asked) > 3


def test_ascent_reaches_the_lowest_point():
    way = run(Ascent(iterations=300, learning_rate=0.1), bowl, [2.0, 0.0, 0.0], 300)
    np.testing.assert_allclose(way[-1][0], LOWEST, atol=1e-3)


def test_ascent_slows_down_along_a_cosine():
    """On an even slope each step of Adam is as long as the learning rate."""
    way = run(Ascent(iterations=100, learning_rate=0.1), lambda x: (float(x[0]), np.ones(1)), [0.0], 100)
    lengths = [float((before - after)[0]) for (before, _), (after, _) in pairwise(way)]
    expected = 0.05 * (1 + np.cos(np.pi * np.arange(100) / 100))
    np.testing.assert_allclose(lengths, expected, atol=1e-6)


@pytest.mark.parametrize(("one", "other", "same"), [
    (LBFGS(), LBFGS(iterations=7, tolerance=1.0), True),
    (LBFGS(), LBFGS(memory=3), False),
    (Ascent(), Ascent(tolerance=1.0), True),
    (Ascent(), Ascent(iterations=7), False),
    (Ascent(), Ascent(learning_rate=0.1), False),
    (LBFGS(), Ascent(), False),
])  # fmt: skip
def test_a_fit_can_go_on_under_the_same_key(one, other, same):
    assert (one.key == other.key) == same
