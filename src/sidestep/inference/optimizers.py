"""Optimizers of a fit: L-BFGS with a line search, Adam, and a variant of Rprop.

An optimizer has three functions over vectors: `init` returns its first state, `step` the next point and state, and
`terminate` tells whether it has converged. The loop that calls them is `maximize`. They minimize a `Loss`, which is
minus the objective. To add an optimizer, subclass `Optimizer`.
"""

import abc
import warnings
from collections.abc import Callable
from functools import partial
from threading import Thread
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sidestep._programs import keep_program
from sidestep._typing import Tree
from sidestep.errors import to_count, to_number

Vector = Float[np.ndarray, " parameters"]


Loss = Callable[..., tuple[float, Vector]]
"""A function `loss(x, *, approximate=False)` to minimize, which returns its value and gradient at x.

`approximate` allows a cheaper value, which omits what has hardly changed since the last evaluation.
"""


_max_iterations = partial(to_count, field="max_iterations", least=0)
_tolerance = partial(to_number, field="tolerance", least=0)
_memory_size = partial(to_count, field="memory_size")
_learning_rate, _initial_step, _max_step = (
    partial(to_number, field=name, above=0) for name in ("learning_rate", "initial_step", "max_step")
)


class Optimizer(eqx.Module):
    """An iterative method that minimizes a loss.

    Attributes:
        max_iterations: The largest number of steps.
        tolerance: The fit has converged when `convergence` is at most this.
        solve_tolerance: The tolerance of the solves of large maps until the optimizer has converged with it.
        approximates: Whether `step` asks for approximate losses.
        scales: Whether parameters are optimized in units of the prior's scale; otherwise steps are in units of θ.
        measure: A format for the number that `convergence` returns.
        resumes_with: The attributes that an interrupted fit must share with the one that resumes it.

    Example:
        >>> isinstance(LBFGS(), Optimizer)
        True
    """

    max_iterations: eqx.AbstractVar[int]
    tolerance: eqx.AbstractVar[float]
    solve_tolerance: ClassVar[float] = 1e-7
    approximates: ClassVar[bool] = False
    scales: ClassVar[bool] = False
    measure: ClassVar[str] = "the largest gradient is {:.2g}"
    resumes_with: ClassVar[tuple[str, ...]] = ()

    @property
    def key(self) -> str:
        """Return what an interrupted fit must share with the one that resumes it."""
        return f"{type(self).__name__} {[getattr(self, name) for name in self.resumes_with]}"

    @abc.abstractmethod
    def init(self, x: Vector) -> Tree:
        """Return the state before the first step from x.

        Args:
            x: The start.

        Returns:
            Any tree of arrays.
        """

    @abc.abstractmethod
    def step(self, loss: Loss, x: Vector, value: float, gradient: Vector, state: Tree) -> tuple[Vector, Tree] | None:
        """Return the next point and state, or None if no step decreases the loss.

        Args:
            loss: The function to minimize.
            x: The present point.
            value: The loss at x.
            gradient: The gradient of the loss at x.
            state: The state that `init` or the last step returned.

        Returns:
            The next point and state, or None.
        """

    def convergence(self, gradient: Vector, state: Tree) -> float:
        """Return the number that `terminate` compares with the tolerance: the largest component of the gradient.

        Args:
            gradient: The gradient of the loss at the present point.
            state: The present state.
        """
        del state
        return float(np.abs(gradient).max(initial=0.0))

    def expected_gain(self, x: Vector, gradient: Vector, state: Tree) -> float:
        """Return how much lower the least loss is than that at x, as far as the optimizer knows its curvature.

        Args:
            x: The present point.
            gradient: The gradient of the loss there.
            state: The present state.

        Returns:
            Nats; infinite where the optimizer knows no curvature, or not that of a minimum.
        """
        del x, gradient, state
        return float("inf")

    def terminate(self, gradient: Vector, state: Tree) -> bool:
        """Return whether the optimizer has converged at a point with this gradient.

        Args:
            gradient: The gradient of the loss at the present point.
            state: The present state.
        """
        return self.convergence(gradient, state) <= self.tolerance


class LBFGS(Optimizer):
    """L-BFGS with a line search for the strong Wolfe conditions (Nocedal & Wright 2006, algorithms 7.4 and 3.5).

    It needs the exact gradient. It differs from the textbook in that 1. the best point of a line search counts even if
    the search fails; 2. where no point is better, the search is repeated once with a cleared memory, for a gain
    above rounding.

    Attributes:
        max_iterations: The largest number of steps.
        tolerance: The fit has converged when no component of the gradient is larger (nats per unit of θ, or per
            standard deviation of the prior where that is less).
        memory_size: The number of steps from which the curvature is estimated.

    Example:
        >>> def loss(x, *, approximate=False):
        ...     return float(x @ x), 2 * x
        >>> optimizer, x = LBFGS(), np.array([1.0])
        >>> after, _ = optimizer.step(loss, x, *loss(x), optimizer.init(x))
        >>> bool(abs(after[0]) < 1)
        True
    """

    max_iterations: int = eqx.field(default=500, static=True, converter=_max_iterations)
    tolerance: float = eqx.field(default=1e-4, static=True, converter=_tolerance)
    memory_size: int = eqx.field(default=20, static=True, converter=_memory_size)
    resumes_with: ClassVar[tuple[str, ...]] = ("memory_size",)
    scales: ClassVar[bool] = True

    def init(self, x: Vector) -> Tree:
        """Return an empty memory."""
        # this import takes as long as the compilation of a program, which leaves Python's lock to others
        Thread(target=__import__, args=("scipy.optimize",)).start()
        return _lbfgs_memory(self.memory_size, x)

    def step(self, loss: Loss, x: Vector, value: float, gradient: Vector, state: Tree) -> tuple[Vector, Tree] | None:
        """Return the best point along the L-BFGS direction, or None if no point is better than x."""
        for restart in (False, True):
            memory = _lbfgs_memory(self.memory_size, x) if restart else state
            direction, updated = _lbfgs_direction(self.memory_size, gradient, memory, x)
            # rounding is no reason to forget the curvature
            least = _LEAST_GAIN * float(np.finfo(x.dtype).eps) * abs(value) if restart else 0.0
            best = _line_search(-np.asarray(direction, dtype=x.dtype), loss, x, value, gradient, least)
            if best is not None:
                return best, updated
        return None

    def expected_gain(self, x: Vector, gradient: Vector, state: Tree) -> float:
        """Return the gain of a Newton step with the curvature of the last steps.

        Where numbers resolve no better point, the gradient that is left is rounding. Steps along which the slope
        changed by less than a few times as much tell no curvature. They are left out, and older ones along which the
        loss is concave. The gain is infinite where no step is left, and where the loss is concave along the last one.
        """
        from scipy.optimize import LbfgsInvHessProduct

        if not gradient.any():
            return 0.0
        _, memory = _lbfgs_direction(self.memory_size, gradient, state, x)
        count, _, _, steps, changes, _ = (np.asarray(leaf, np.float64) for leaf in memory)
        # oldest first, as the newest of those that are kept sets the scale
        steps, changes = (np.roll(each, 1 - int(count), axis=0) for each in (steps, changes))
        curvature = (steps * changes).sum(axis=1)
        rounding = np.linalg.norm(gradient) * np.linalg.norm(steps, axis=1)
        certain = np.flatnonzero(np.abs(curvature) > _CERTAIN * rounding)
        if not certain.size or curvature[certain[-1]] < 0:
            return float("inf")
        convex = certain[curvature[certain] > 0]
        steps, changes, curvature = steps[convex], changes[convex], curvature[convex]
        scale = np.sqrt(curvature[-1] / (changes[-1] @ changes[-1]))
        slope = scale * np.asarray(gradient, np.float64)
        return float(slope @ LbfgsInvHessProduct(steps / scale, changes * scale).matvec(slope)) / 2


_LEAST_GAIN = 8.0
"""The least gain of a search with a cleared memory, in units of the loss's last digit."""
_CERTAIN = 4.0
"""How many times the gradient that is left the slope has to change along a step that tells the curvature."""


class Adam(Optimizer):
    """Adam (Kingma & Ba 2015) with a learning rate that decreases to 0 along a cosine (Loshchilov & Hutter 2017).

    It needs no line search, and so works with the fixed-policy gradient too.

    Attributes:
        max_iterations: The number of steps, unless it converges before; the length of the cosine.
        learning_rate: The first learning rate, in units of θ.
        tolerance: The fit has converged when no component of the gradient is larger (nats per unit of θ).

    Example:
        >>> def loss(x, *, approximate=False):
        ...     return float(x @ x), 2 * x
        >>> optimizer, x = Adam(), np.array([1.0])
        >>> after, _ = optimizer.step(loss, x, *loss(x), optimizer.init(x))
        >>> bool(abs(after[0]) < 1)
        True
    """

    max_iterations: int = eqx.field(default=2000, static=True, converter=_max_iterations)
    learning_rate: float = eqx.field(default=0.2, static=True, converter=_learning_rate)
    tolerance: float = eqx.field(default=1e-2, static=True, converter=_tolerance)
    resumes_with: ClassVar[tuple[str, ...]] = ("learning_rate", "max_iterations")

    def _transformation(self) -> Any:
        import optax

        return optax.adam(optax.cosine_decay_schedule(self.learning_rate, self.max_iterations))

    def init(self, x: Vector) -> Tree:
        """Return the first moments."""
        return self._transformation().init(x)

    def step(self, loss: Loss, x: Vector, value: float, gradient: Vector, state: Tree) -> tuple[Vector, Tree]:
        """Return the next point and moments."""
        del loss, value
        update, state = self._transformation().update(gradient, state, x)
        return x + np.asarray(update, dtype=x.dtype), state


class Rprop(Optimizer):
    """A variant of Rprop (Riedmiller & Braun 1993) for objectives with cliffs; it needs the exact gradient.

    A gap in a wall that would save an agent a thousand steps changes its path only where passing it takes fewer
    attempts. There the objective of agents that walked around falls by thousands of nats within a thousandth of a unit
    of θ. At the optimum hundreds of parameters are at such a cliff each, which a quasi-Newton method takes for a kink.

    As in Rprop, each parameter has a step size, and only the sign of its gradient gives the direction. It differs:

    1. A step is accepted only if the loss decreases, and if parameters that overshot (a new sign of the gradient) take
       back at most .15 of the decrease that the gradient predicted.
    2. Otherwise parameters that take back more than .15 of their own predicted decrease keep their values, their step
       sizes are multiplied by .25, and the trial is repeated without them. If there are none, all steps of this trial
       are multiplied by .25.
    3. After an accepted step, step sizes grow by 1.4 (1.2 in Rprop), or by 4 where the gradient has become steeper, and
       are multiplied by .25 (.5 in Rprop) where the gradient has changed sign.
    4. A trial without some parameters is evaluated approximately first, and again if it is acceptable.

    Attributes:
        max_iterations: The largest number of steps; each may take several evaluations.
        tolerance: The fit has converged when the gradient predicts a smaller gain of the next step (nats, all
            parameters together).
        initial_step: The first step size of each parameter, in units of θ.
        max_step: The largest step size, in units of θ.

    Example:
        >>> def loss(x, *, approximate=False):
        ...     return float(x @ x), 2 * x
        >>> optimizer, x = Rprop(), np.array([1.0])
        >>> after, _ = optimizer.step(loss, x, *loss(x), optimizer.init(x))
        >>> bool(abs(after[0]) < 1)
        True
    """

    max_iterations: int = eqx.field(default=500, static=True, converter=_max_iterations)
    tolerance: float = eqx.field(default=1.0, static=True, converter=_tolerance)
    initial_step: float = eqx.field(default=0.7, static=True, converter=_initial_step)
    max_step: float = eqx.field(default=1.5, static=True, converter=_max_step)
    solve_tolerance: ClassVar[float] = 1e-5
    approximates: ClassVar[bool] = True
    measure: ClassVar[str] = "the next step promises {:.2g} nats"
    resumes_with: ClassVar[tuple[str, ...]] = ("initial_step", "max_step")

    def init(self, x: Vector) -> Vector:
        """Return the first step sizes."""
        return np.full_like(x, self.initial_step)

    def step(
        self, loss: Loss, x: Vector, value: float, gradient: Vector, state: Vector
    ) -> tuple[Vector, Vector] | None:
        """Return the end of the first acceptable step and the new step sizes, or None if no step is acceptable."""
        sizes, free, scale, approximate = state, gradient != 0, 1.0, False
        for _ in range(_MAX_TRIALS):
            step = np.where(free, -scale * sizes * np.sign(gradient), 0).astype(x.dtype)
            predicted = -gradient * step
            trial = _Trial(step, *loss(x + step, approximate=approximate))
            if approximate and trial.is_acceptable(value, predicted):
                trial = _Trial(step, *loss(x + step))
            overshoot = trial.overshoot
            if trial.is_acceptable(value, predicted):
                growth = np.where(np.abs(trial.gradient) >= np.abs(gradient), _GROWTH_IF_STEEPER, _GROWTH)
                grown = np.where(free, np.minimum(growth * sizes, self.max_step), sizes)
                return x + step, np.where(overshoot > 0, _SHRINKAGE * sizes, grown).astype(x.dtype)
            too_far = overshoot > _MAX_OVERSHOOT * predicted
            if too_far.any():
                sizes, free = np.where(too_far, _SHRINKAGE * sizes, sizes), free & ~too_far
            else:
                scale *= _SHRINKAGE
            free = free if free.any() else gradient != 0
            # parameters that are put back change few tasks; a shorter step changes many
            approximate = bool(too_far.any())
        return None

    def convergence(self, gradient: Vector, state: Vector) -> float:
        """Return the gain in nats that the gradient predicts for the next step."""
        return float(np.abs(gradient) @ state)


_GROWTH, _GROWTH_IF_STEEPER, _SHRINKAGE = 1.4, 4.0, 0.25
_MAX_OVERSHOOT = 0.15
"""The largest part of the predicted decrease that parameters may take back."""
_MAX_TRIALS = 40


class _Trial(NamedTuple):
    """A step of `Rprop`, and the loss and its gradient at the step's end."""

    step: Vector
    value: float
    gradient: Vector

    @property
    def overshoot(self) -> Vector:
        """What each parameter takes back at the end of the step: 0 where the loss still decreases or is infinite."""
        return np.maximum(self.gradient * self.step, 0) if np.isfinite(self.value) else np.zeros_like(self.step)

    def is_acceptable(self, value: float, predicted: Vector) -> bool:
        return bool(self.value < value and self.overshoot.sum() <= _MAX_OVERSHOOT * predicted.sum())


@keep_program
def _lbfgs_memory(memory_size: int, x: Vector | Array) -> Tree:
    """Return the arrays of optax's empty memory: where programs are kept, a fit does not import optax."""
    import optax

    return jax.tree.leaves(optax.scale_by_lbfgs(memory_size).init(jnp.asarray(x)))


@keep_program
def _lbfgs_direction(memory_size: int, gradient: Vector | Array, memory: Tree, x: Vector | Array) -> tuple[Array, Tree]:
    import optax

    x, transformation = jnp.asarray(x), optax.scale_by_lbfgs(memory_size)
    state = jax.tree.unflatten(jax.tree.structure(jax.eval_shape(transformation.init, x)), memory)
    direction, state = transformation.update(jnp.asarray(gradient), state, x)
    return jnp.asarray(direction), jax.tree.leaves(state)


def _line_search(
    direction: Vector, loss: Loss, x: Vector, value: float, gradient: Vector, least: float
) -> Vector | None:
    """Return the best point of a line search for the strong Wolfe conditions; None for no more gain than `least`."""
    from scipy.optimize import line_search

    points: dict[float, Vector] = {value: x}

    # the search computes in 64-bit numbers whatever the parameters are
    def value_at(point: Vector) -> float:
        point = point.astype(x.dtype)
        value = loss(point)[0]
        points[value] = point
        return value

    def gradient_at(point: Vector) -> Vector:
        return loss(point.astype(x.dtype))[1]

    with warnings.catch_warnings():
        # a search without a point of the required curvature warns; its best point may be better than x all the same
        warnings.simplefilter("ignore", RuntimeWarning)
        line_search(value_at, gradient_at, x, direction, gfk=gradient, old_fval=value, maxiter=20)
    best = min(points)
    return points[best] if value - best > least else None
