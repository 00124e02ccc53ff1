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
    assert optimizer.expected_gain(x, gradient, state) == pytest.approx(value, rel=0.3)


def test_expected_gain_of_lbfgs_after_a_step_of_rounding_leaves_it_out():
    """A last step of 10⁻⁶ along which the gradient seems to fall."""
    optimizer, x = LBFGS(), np.array([5.0, -4.0])
    state = optimizer.init(x)
    for _ in range(3):
        x, state = optimizer.step(loss, x, *loss(x), state) or (x, state)
    _, state = optimizer.step(loss, x, *loss(x), state) or (x, state)  # the memory goes up to x
    value, gradient = loss(x)
    noisy = x + 1e-6, gradient + np.array([1e-4, -2e-4]), state
    assert optimizer.expected_gain(*noisy) == pytest.approx(value, rel=0.3)


def test_expected_gain_of_lbfgs_with_a_full_memory_is_that_of_its_last_steps():
    """Two updates of the inverse Hessian (BFGS) beside, from the scale of the last step."""
    curvature, optimizer = np.array([1.0, 1.05, 1.1, 1.15, 1.2]), LBFGS(memory_size=2)

    def many(x, *, approximate=False):
        del approximate
        return float(curvature @ x**2) / 2, curvature * x

    places = [np.full(5, 2.0)]
    state = optimizer.init(places[0])
    for _ in range(4):
        x, state = optimizer.step(many, places[-1], *many(places[-1]), state) or (places[-1], state)
        places.append(x)
    steps = np.diff(places, axis=0)[-2:]
    changes = steps * curvature
    inverse = np.eye(5) * (steps[-1] @ changes[-1]) / (changes[-1] @ changes[-1])
    for step, change in zip(steps, changes, strict=True):
        project = np.eye(5) - np.outer(step, change) / (step @ change)
        inverse = project @ inverse @ project.T + np.outer(step, step) / (step @ change)
    gradient = curvature * places[-1]
    lengths = np.linalg.norm(steps, axis=1)
    assert ((steps * changes).sum(axis=1) > 4 * np.linalg.norm(gradient) * lengths).all()  # both steps count
    expected = gradient @ inverse @ gradient / 2
    assert optimizer.expected_gain(places[-1], gradient, state) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("optimizer", [Adam(), Rprop()])
def test_expected_gain_without_curvature_is_infinite(optimizer):
    x = np.array([1.0, -2.0])
    assert optimizer.expected_gain(x, loss(x)[1], optimizer.init(x)) == np.inf


def test_expected_gain_of_lbfgs_where_the_loss_is_concave_is_infinite():
    """The loss −x³/3 is concave above 0, so that the memory of a step has a negative curvature."""

    def concave(x, *, approximate=False):
        del approximate
        return -float(np.sum(x**3)) / 3 if abs(x[0]) < 3 else np.inf, -(x**2)

    optimizer, x = LBFGS(), np.array([1.0])
    after = optimizer.step(concave, x, *concave(x), optimizer.init(x))
    assert after is not None
    x, state = after
    assert optimizer.expected_gain(x, concave(x)[1], state) == np.inf
    assert optimizer.expected_gain(x, np.zeros(1), state) == 0
