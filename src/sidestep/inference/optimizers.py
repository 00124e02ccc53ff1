"""How a fit climbs: L-BFGS with a line search, first-order ascent, or steps that stay off cliffs.

An optimiser is three pure functions over vectors: `init` makes what it carries from step to step, `step` takes one, and
`settled` says why it has converged, if it has. It is given the loss (minus the objective) as a function, `Evaluate`.
Its `exactness` says how exact solves have to be until it has converged, `looks_roughly` whether it takes rough looks.
"""

import warnings
from typing import ClassVar, Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PyTree
from scipy.optimize import line_search

Vector = Float[np.ndarray, " parameters"]


@runtime_checkable
class Evaluate(Protocol):
    """The loss, and its slope."""

    def __call__(self, x: Vector, *, rough: bool = False) -> tuple[float, Vector]:
        """Both at x; a rough look may leave out what seems to be as it was where the last look was, and costs less."""
        ...


class LBFGS(eqx.Module):
    """L-BFGS with a line search for the strong Wolfe conditions; needs the exact gradient.

    - `iterations`: when to stop at the latest.
    - `tolerance`: the fit has converged when no component of the gradient is larger (nats per unit of θ).
    - `memory`: how many steps the curvature is learned from.
    """

    iterations: int = eqx.field(default=500, static=True)
    tolerance: float = eqx.field(default=1e-4, static=True)
    memory: int = eqx.field(default=20, static=True)
    exactness: ClassVar[float] = 1e-7
    looks_roughly: ClassVar[bool] = False

    @property
    def key(self) -> str:
        """What an interrupted fit must share with the one that resumes it."""
        return f"L-BFGS {self.memory}"

    def init(self, x: Vector) -> PyTree[Array]:
        """The steps and changes of gradient to learn from: none yet."""
        return optax.scale_by_lbfgs(self.memory).init(x)

    def step(
        self, evaluate: Evaluate, x: Vector, value: float, slope: Vector, state: PyTree[Array]
    ) -> tuple[Vector, PyTree[Array]] | None:
        """The next point; None where no step along the direction gains anything."""
        direction, learned = _lbfgs_direction(self.memory, slope, state, x)
        found = _best_along(-np.asarray(direction, dtype=x.dtype), evaluate, x, value, slope)
        if found is not None:
            return found, learned
        # what was learned of the curvature may mislead where the objective bends sharply: forget it once
        direction, learned = _lbfgs_direction(self.memory, slope, self.init(x), x)
        found = _best_along(-np.asarray(direction, dtype=x.dtype), evaluate, x, value, slope)
        return None if found is None else (found, learned)

    def settled(self, slope: Vector, state: PyTree[Array]) -> str:
        """Why it has converged, or nothing."""
        del state
        return _why_flat(slope, self.tolerance)


class Adam(eqx.Module):
    """First-order ascent (Adam with a rate that falls to nothing along a cosine), with either gradient.

    - `iterations`: when to stop at the latest, and the length of the cosine.
    - `learning_rate`: the first rate, in units of θ.
    - `tolerance`: as for `LBFGS`.
    """

    iterations: int = eqx.field(default=2000, static=True)
    learning_rate: float = eqx.field(default=0.2, static=True)
    tolerance: float = eqx.field(default=1e-2, static=True)
    exactness: ClassVar[float] = 1e-7
    looks_roughly: ClassVar[bool] = False

    @property
    def key(self) -> str:
        """What an interrupted fit must share with the one that resumes it: here the rate's whole schedule."""
        return f"ascent {self.learning_rate} {self.iterations}"

    def _adam(self) -> optax.GradientTransformation:
        return optax.adam(optax.cosine_decay_schedule(self.learning_rate, self.iterations))

    def init(self, x: Vector) -> PyTree[Array]:
        """The running means of the gradient and its square."""
        return self._adam().init(x)

    def step(
        self, evaluate: Evaluate, x: Vector, value: float, slope: Vector, state: PyTree[Array]
    ) -> tuple[Vector, PyTree[Array]]:
        """The next point."""
        del evaluate, value
        update, state = self._adam().update(slope, state, x)
        return x + np.asarray(update, dtype=x.dtype), state

    def settled(self, slope: Vector, state: PyTree[Array]) -> str:
        """Why it has converged, or nothing."""
        del state
        return _why_flat(slope, self.tolerance)


class Rprop(eqx.Module):
    """Ascent with a step of its own for every parameter, that stays off cliffs; needs the exact gradient.

    A gap in a wall that would save people a thousand steps does not tempt them while passing it takes more tries than
    that. Where it begins to, the objective of people who walked around falls by thousands of nats within a thousandth
    of a unit of θ. At the optimum hundreds of parameters stand each at such a cliff of its own, which is as good as a
    kink to a quasi-Newton method.

    So only the gradient's signs give the direction (resilient propagation, Riedmiller and Braun 1993). A step is taken
    if the objective rises and at most the share 0.15 of what the slope promised is pushed back by parameters whose
    slope has turned. Otherwise those that push back more than that share of their own stay where they are, with a
    quarter of their step, and it is tried again without them; where there are none, with all steps a quarter as long,
    this time. Where a step was taken it grows by 1.4, by 4 if the slope has become steeper on the way, and falls to a
    quarter where the slope has turned.

    - `iterations`: how many steps are taken at most; each may need several evaluations.
    - `tolerance`: the fit has converged when its next step promises less than this (nats, all parameters together).
    - `first`, `longest`: the first and the longest step, in units of θ.
    """

    iterations: int = eqx.field(default=500, static=True)
    tolerance: float = eqx.field(default=1.0, static=True)
    first: float = eqx.field(default=0.7, static=True)
    longest: float = eqx.field(default=1.5, static=True)
    exactness: ClassVar[float] = 1e-5
    looks_roughly: ClassVar[bool] = True

    @property
    def key(self) -> str:
        """What an interrupted fit must share with the one that resumes it."""
        return f"resilient {self.first} {self.longest}"

    def init(self, x: Vector) -> Vector:
        """The first step of every parameter."""
        return np.full_like(x, self.first)

    def step(
        self, evaluate: Evaluate, x: Vector, value: float, slope: Vector, state: Vector
    ) -> tuple[Vector, Vector] | None:
        """The next point; None where none that was tried gains anything."""
        lengths, free, share, rough = state, slope != 0, 1.0, False
        for _ in range(_TRIALS):
            step = np.where(free, -share * lengths * np.sign(slope), 0).astype(x.dtype)
            promised = -slope * step
            after, new_slope = evaluate(x + step, rough=rough)
            if rough and _gains(value, promised, after, _pushed_back(step, after, new_slope)):
                after, new_slope = evaluate(x + step)
            pushed_back = _pushed_back(step, after, new_slope)
            if _gains(value, promised, after, pushed_back):
                growth = np.where(np.abs(new_slope) >= np.abs(slope), _STEEPER, _GROWTH)
                grown = np.where(free, np.minimum(growth * lengths, self.longest), lengths)
                return x + step, np.where(pushed_back > 0, _CUT * lengths, grown).astype(x.dtype)
            too_far = pushed_back > _PUSHED_BACK * promised
            if too_far.any():
                lengths, free = np.where(too_far, _CUT * lengths, lengths), free & ~too_far
            else:
                share *= _CUT
            free = free if free.any() else slope != 0
            # few people have to do with parameters that are put back, and many with a shorter step
            rough = bool(too_far.any())
        return None

    def settled(self, slope: Vector, state: Vector) -> str:
        """Why it has converged, or nothing."""
        promised = np.abs(slope) @ state
        return f"the next step promises {promised:.2g} nats" if promised <= self.tolerance else ""


Optimizer = LBFGS | Adam | Rprop

_GROWTH, _STEEPER, _CUT, _PUSHED_BACK = 1.4, 4.0, 0.25, 0.15
"""By how much a step grows, grows on a slope that becomes steeper, and falls; which share may be pushed back."""
_TRIALS = 40
"""How often a step of `Rprop` is tried, with fewer and fewer parameters or shorter, before it is given up."""


def _pushed_back(step: Vector, after: float, new_slope: Vector) -> Vector:
    """What each parameter pushes back at the end of a step: nothing where the loss still falls, or is not known."""
    return np.maximum(new_slope * step, 0) if np.isfinite(after) else np.zeros_like(step)


def _gains(value: float, promised: Vector, after: float, pushed_back: Vector) -> bool:
    """Whether the loss falls along a step, and little of what the slope promised is pushed back at its end."""
    return bool(after < value and pushed_back.sum() <= _PUSHED_BACK * promised.sum())


def _why_flat(slope: Vector, tolerance: float) -> str:
    """That no component of a slope is larger than a tolerance, in words; nothing if one is."""
    largest = np.abs(slope).max()
    return f"the largest gradient is {largest:.2g}" if largest <= tolerance else ""


@eqx.filter_jit
def _lbfgs_direction(
    memory: int,
    slope: Float[Array | np.ndarray, " parameters"],
    state: PyTree[Array],
    x: Float[Array | np.ndarray, " parameters"],
) -> tuple[Array, PyTree[Array]]:
    direction, state = optax.scale_by_lbfgs(memory).update(jnp.asarray(slope), state, jnp.asarray(x))
    return jnp.asarray(direction), state


def _best_along(direction: Vector, evaluate: Evaluate, x: Vector, value: float, slope: Vector) -> Vector | None:
    """The best point that a line search for the strong Wolfe conditions meets; None if none is better than `x`."""
    tried: dict[float, Vector] = {value: x}

    # the search computes in 64-bit numbers whatever the parameters are
    def loss(point: Vector) -> float:
        point = point.astype(x.dtype)
        found = evaluate(point)[0]
        tried[found] = point
        return found

    with warnings.catch_warnings():
        # a search that meets no point with the right curvature says so; its best point may gain all the same
        warnings.simplefilter("ignore", RuntimeWarning)
        line_search(
            loss, lambda point: evaluate(point.astype(x.dtype))[1], x, direction, gfk=slope, old_fval=value, maxiter=20
        )
    best = min(tried)
    return None if best >= value else tried[best]
