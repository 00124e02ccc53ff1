"""How a fit climbs: L-BFGS with a line search, or first-order ascent.

An optimiser is a pair of pure functions over vectors: `init` makes what it carries from step to step, `step` takes one.
It is given the loss (minus the objective) as a function `evaluate(x) -> (value, slope)`.
"""

import warnings
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PyTree
from scipy.optimize import line_search

Vector = Float[np.ndarray, " parameters"]
Evaluate = Callable[[Vector], tuple[float, Vector]]


class LBFGS(eqx.Module):
    """L-BFGS with a line search for the strong Wolfe conditions; needs the exact gradient.

    - `iterations`: when to stop at the latest.
    - `tolerance`: the fit has converged when no component of the gradient is larger (nats per unit of θ).
    - `memory`: how many steps the curvature is learned from.
    """

    iterations: int = eqx.field(default=500, static=True)
    tolerance: float = eqx.field(default=1e-4, static=True)
    memory: int = eqx.field(default=20, static=True)

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


class Ascent(eqx.Module):
    """First-order ascent (Adam with a rate that falls to nothing along a cosine), with either gradient.

    - `iterations`: when to stop at the latest, and the length of the cosine.
    - `learning_rate`: the first rate, in units of θ.
    - `tolerance`: as for `LBFGS`.
    """

    iterations: int = eqx.field(default=2000, static=True)
    learning_rate: float = eqx.field(default=0.2, static=True)
    tolerance: float = eqx.field(default=1e-2, static=True)

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


Optimiser = LBFGS | Ascent


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
