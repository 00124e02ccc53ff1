"""The optimisers on functions whose lowest point is known."""

from itertools import pairwise

import numpy as np
import pytest

from sidestep.inference.optimizers import LBFGS, Adam, Rprop

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


def exactly(function):
    """A function as optimisers take it, whose rough looks are as good as any other."""

    def evaluate(x, rough=False):
        del rough
        return function(x)

    return evaluate


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


def test_resilient_ascent_keeps_the_dtype_of_the_start():
    def in_32_bit(x):
        return bowl(x)[0], bowl(x)[1].astype(np.float32)

    x = np.full(3, 4.0, dtype=np.float32)
    state = Rprop().init(x)
    for _ in range(3):
        value, slope = in_32_bit(x)
        after = Rprop().step(exactly(in_32_bit), x, value, slope, state)
        assert after is not None
        x, state = after
        assert (x.dtype, state.dtype) == (np.float32, np.float32)


@pytest.mark.parametrize(("function", "start", "lowest", "steps"), [
    (bowl, [5.0, 5.0, 5.0], LOWEST, 30),
    (banana, [-1.2, 1.0], [1, 1], 60),
    (cliff, [-40.0], [1], 30),
])  # fmt: skip
def test_lbfgs_goes_downhill_to_the_lowest_point(function, start, neg_inf, steps):
    way = run(LBFGS(), function, start, steps)
    values = [value for _, value in way]
    assert all(after < before for before, after in pairwise(values))
    np.testing.assert_allclose(way[-1][0], neg_inf, atol=1e-5)


def test_lbfgs_says_where_nothing_can_be_gained():
    assert LBFGS().step(exactly(bowl), LOWEST, *bowl(LOWEST), LBFGS().init(LOWEST)) is None
    pit = np.zeros(1)
    ridge = exactly(lambda x: (float(np.abs(x).sum()), np.ones(1)))
    assert LBFGS().step(ridge, pit, 0.0, np.ones(1), LBFGS().init(pit)) is None


def test_points_have_the_dtype_of_the_start():
    """In a ravine so narrow that the first step is too long, and the search has to come back."""
    asked = []

    def ravine(x):
        asked.append(x.dtype)
        return float(np.sum((100 * x) ** 4)), (400 * (100 * x) ** 3).astype(np.float32)

    x = np.array([0.05, 0.03], dtype=np.float32)
    after = LBFGS().step(exactly(ravine), x, *ravine(x), LBFGS().init(x))
    assert after is not None
    assert after[0].dtype == np.float32
    assert set(asked) == {np.dtype(np.float32)}
    assert len(asked) > 3


def test_ascent_reaches_the_lowest_point():
    way = run(Adam(iterations=300, learning_rate=0.1), bowl, [2.0, 0.0, 0.0], 300)
    np.testing.assert_allclose(way[-1][0], LOWEST, atol=1e-3)


def test_ascent_slows_down_along_a_cosine():
    """On an even slope each step of Adam is as long as the learning rate."""
    way = run(Adam(iterations=100, learning_rate=0.1), lambda x: (float(x[0]), np.ones(1)), [0.0], 100)
    lengths = [float((before - after)[0]) for (before, _), (after, _) in pairwise(way)]
    expected = 0.05 * (1 + np.cos(np.pi * np.arange(100) / 100))
    np.testing.assert_allclose(lengths, expected, atol=1e-6)


HEIGHTS = np.array([0.5, 2.0, 6.0, 7.0])


def cliffs(x):
    """Rises gently with the distance from 0, and steeply, by thousands, below a height of its own in each direction.

    The edges are so sharp that at the lowest point the slope would have to be known to a billionth of a unit.
    """
    below = 1e6 * (HEIGHTS - x)
    value = np.sum(x**2 / 8) + np.sum(5e-3 * np.logaddexp(0, below))
    odds = np.exp(np.minimum(below, 0)) / (1 + np.exp(-np.abs(below)))
    return float(value), x / 4 - 5e3 * odds


def test_resilient_ascent_stops_at_the_edge_of_cliffs():
    optimizer = Rprop(tolerance=1e-3)
    x, state, asked = np.full(4, 9.0), optimizer.init(np.full(4, 9.0)), []

    def evaluate(x):
        asked.append(x)
        return cliffs(x)

    for _ in range(100):
        if optimizer.settled(cliffs(x)[1], state):
            break
        after = optimizer.step(exactly(evaluate), x, *cliffs(x), state)
        assert after is not None
        assert cliffs(after[0])[0] < cliffs(x)[0]
        x, state = after
        # none that was taken has fallen deep below an edge
        assert (x > HEIGHTS - 0.01).all()
    assert optimizer.settled(cliffs(x)[1], state)
    np.testing.assert_allclose(x, HEIGHTS, atol=2e-3)
    assert len(asked) < 200


def test_a_step_that_failed_is_no_sign_of_convergence():
    """Where there are no values the step is tried shorter, but the next one is as long as ever."""
    optimizer = Rprop(first=1.0)
    x = np.array([-40.0])
    after = optimizer.step(exactly(lambda x: cliff(x + 40.5)), x, *cliff(x + 40.5), optimizer.init(x))
    assert after is not None
    np.testing.assert_allclose(after, ([-39.75], [1.4]))


def test_resilient_ascent_leaves_out_only_what_pushes_back():
    """A second parameter's cliff does not hold up the first one."""
    optimizer = Rprop(first=1.0)
    x = np.array([5.0, 2.2])

    def evaluate(x):
        return float(x @ x / 8 + 1e3 * max(2.0 - x[1], 0)), np.array([x[0] / 4, x[1] / 4 - 1e3 * (x[1] < 2.0)])

    after = optimizer.step(exactly(evaluate), x, *evaluate(x), optimizer.init(x))
    assert after is not None
    np.testing.assert_array_equal(after[0], [4.0, 2.2])
    np.testing.assert_allclose(after[1], [1.4, 0.25])


def test_resilient_ascent_does_not_rely_on_rough_looks():
    """Rough looks overlook the second parameter's cliff, and all that they say is looked at once more."""
    optimizer = Rprop(first=1.0)
    x, roughly = np.array([5.0, 2.2, 2.2]), []

    def evaluate(x, rough=False):
        roughly.append(rough)
        below = np.array([0.0, not rough and x[1] < 2.0 and x[2] >= 2.0, x[2] < 2.0])
        return float(x @ x / 8 + 1e3 * below @ np.maximum(2.0 - x, 0)), x / 4 - 1e3 * below

    after = optimizer.step(evaluate, x, *evaluate(x), optimizer.init(x))
    assert after is not None
    np.testing.assert_array_equal(after[0], [4.0, 2.2, 2.2])
    # the start; all three, which meets the third one's cliff; without it, twice; without the second one, twice
    assert roughly == [False, False, True, False, True, False]


def test_resilient_ascent_looks_at_all_where_a_step_is_too_long():
    """Beyond .5 is a plateau whose slope says nothing of it, so rough looks from there would not see it left."""
    optimizer, beyond = Rprop(first=1.0), [False]
    x = np.array([0.0])

    def evaluate(x, rough=False):
        if not rough:
            beyond[0] = bool(x[0] > 0.5)
        return float(1e3 * beyond[0] - x[0]), np.array([-1.0])

    after = optimizer.step(evaluate, x, *evaluate(x), optimizer.init(x))
    assert after is not None
    np.testing.assert_array_equal(after[0], [0.25])


def test_resilient_ascent_comes_back_up_quickly():
    """Where a slope becomes steeper on the way, the next step is four times as long."""
    optimizer = Rprop(first=0.01)
    x = np.array([0.0])

    def evaluate(x):
        return float(-np.exp(x[0])), -np.exp(x)

    after = optimizer.step(exactly(evaluate), x, *evaluate(x), optimizer.init(x))
    assert after is not None
    np.testing.assert_allclose(after, ([0.01], [0.04]))


def test_resilient_ascent_says_where_nothing_can_be_gained():
    pit = np.zeros(2)
    optimizer = Rprop()
    ridge = exactly(lambda x: (float(np.abs(x).sum()), np.ones(2)))
    assert optimizer.step(ridge, pit, 0.0, np.ones(2), optimizer.init(pit)) is None
    assert optimizer.step(exactly(bowl), LOWEST, *bowl(LOWEST), optimizer.init(LOWEST)) is None


def test_optimisers_say_why_they_have_converged():
    slope, lengths = np.array([0.5, -2.0]), np.array([1.0, 0.1])
    assert not LBFGS(tolerance=1.9).settled(slope, None)
    assert LBFGS(tolerance=2.0).settled(slope, None) == "the largest gradient is 2"
    assert not Adam(tolerance=1.9).settled(slope, None)
    assert not Rprop(tolerance=0.69).settled(slope, lengths)
    assert Rprop(tolerance=0.71).settled(slope, lengths) == "the next step promises 0.7 nats"


@pytest.mark.parametrize(("one", "other", "same"), [
    (LBFGS(), LBFGS(iterations=7, tolerance=1.0), True),
    (LBFGS(), LBFGS(memory=3), False),
    (Adam(), Adam(tolerance=1.0), True),
    (Adam(), Adam(iterations=7), False),
    (Adam(), Adam(learning_rate=0.1), False),
    (LBFGS(), Adam(), False),
    (Rprop(), Rprop(iterations=7, tolerance=2.0), True),
    (Rprop(), Rprop(first=0.1), False),
])  # fmt: skip
def test_a_fit_can_go_on_under_the_same_key(one, other, same):
    assert (one.key == other.key) == same
