"""How much an optimizer expects to gain, on quadratic losses where that is known."""

import numpy as np
import pytest

from sidestep.inference.optimizers import LBFGS, Adam, Rprop

CURVATURE = np.array([[3.0, 1.0], [1.0, 2.0]])


def loss(x, *, approximate=False):
    del approximate
    return float(x @ CURVATURE @ x) / 2, CURVATURE @ x


def test_expected_gain_of_lbfgs_becomes_that_of_the_quadratic():
    optimizer, x = LBFGS(), np.array([5.0, -4.0])
    state = optimizer.init(x)
    for _ in range(3):
        after = optimizer.step(loss, x, *loss(x), state)
        assert after is not None
        x, state = after
    value, gradient = loss(x)
    assert optimizer.expected_gain(x, gradient, state, 1e-9) == pytest.approx(value, rel=0.3)
    # of a step that is too short, the change of the gradient is rounding
    noise = np.array([1e-3, -2e-3])
    assert optimizer.expected_gain(x + 1e-6, gradient + noise, state, 1e-6) == pytest.approx(value, rel=0.3)
    assert optimizer.expected_gain(x, gradient, state, 1e3) == np.inf


@pytest.mark.parametrize("optimizer", [Adam(), Rprop()])
def test_expected_gain_without_curvature_is_infinite(optimizer):
    x = np.array([1.0, -2.0])
    assert optimizer.expected_gain(x, loss(x)[1], optimizer.init(x), 1e-9) == np.inf


def test_expected_gain_of_lbfgs_where_the_loss_is_concave_is_infinite():
    """The loss −x³/3 is concave above 0, so that the memory of a step has a negative curvature."""

    def concave(x, *, approximate=False):
        del approximate
        return -float(np.sum(x**3)) / 3 if abs(x[0]) < 3 else np.inf, -(x**2)

    optimizer, x = LBFGS(), np.array([1.0])
    after = optimizer.step(concave, x, *concave(x), optimizer.init(x))
    assert after is not None
    x, state = after
    assert optimizer.expected_gain(x, concave(x)[1], state, 1e-9) == np.inf
    assert optimizer.expected_gain(x, np.zeros(1), state, 1e-9) == 0
