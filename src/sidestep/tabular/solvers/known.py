"""A solver for values and adjoints that are known: second derivatives at a solution need no other solve of it.

A program with the sweeps of a solver takes longer to compile than all that is computed at their fixed point.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sidestep.tabular.arrays import to_jax
from sidestep.tabular.backups import Gradient
from sidestep.tabular.solvers import base
from sidestep.tabular.solvers.base import BellmanEquation, Region, Values, WarmStart


class Known(base.Solver):
    """Returns V and λ as the start has them: those of an earlier solve of the same equation and cotangent.

    An adjoint that has not converged is NaN, and stays it. Products with the Hessian are by `jax.linearize` of the
    gradient: `jax.hessian` fails in JAX's batching of forward derivatives.

    Attributes:
        tolerance: That of the earlier solve, for linear equations at the fixed point.
        max_sweeps: Without effect.
    """

    tolerance: base.Tolerance = None
    max_sweeps: int = eqx.field(static=True, default=0)

    def cold_start(self, states: int, dtype: jnp.dtype) -> WarmStart:
        """Return a start of which nothing is known."""
        unknown = to_jax(np.full(states, np.nan, dtype))
        return WarmStart(unknown, unknown, to_jax(np.zeros(0, np.int32)))

    def values(self, equation: BellmanEquation, start: WarmStart, region: Region) -> base.SolveResult:
        """Return the values of the start."""
        del equation, region
        return _result(start.values, start)

    def vjp(
        self, equation: BellmanEquation, gradient: Gradient, cotangent: Values, start: WarmStart, region: Region
    ) -> tuple[base.Cotangents, base.SolveResult]:
        """Return the gradient by the adjoint of the start, whatever the cotangent."""
        del cotangent, region
        pulled = jax.vjp(lambda by: equation.at(by).backed_up(start.values, gradient), equation.inputs)[1]
        by = jax.tree.map(
            lambda leaf: jnp.where(jnp.isfinite(start.adjoint).all(), leaf, jnp.nan), pulled(start.adjoint)[0]
        )
        return by, _result(start.adjoint, start)


def _result(values: Values, start: WarmStart) -> base.SolveResult:
    """Return what is known as a result without sweeps."""
    none = jnp.zeros((), values.dtype)
    return base.SolveResult(values, start.order, jnp.zeros((), jnp.int32), none, none, jnp.array(True))
