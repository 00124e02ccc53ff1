"""Sweeps in the order of distance, one state after another, as machine code on the CPU.

Here is what JAX sees. On the host, `outwards` finds values, from the goal outwards, and `inwards` the adjoint, back
again; `order` finds the order. A solve that starts from an earlier one takes over its order as long as that serves.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sidestep.errors import InputError
from sidestep.tabular.backups import Backup, BoltzmannAverage, Gradient, HardMax, LogSumExp, Mellowmax
from sidestep.tabular.solvers.adjoint import vjp
from sidestep.tabular.solvers.base import (
    Beta,
    Cotangents,
    DecisionProcess,
    Region,
    Solver,
    SolveResult,
    Tolerance,
    WarmStart,
    lower_bound,
    neg_inf,
)
from sidestep.tabular.solvers.given import look_up
from sidestep.tabular.solvers.native import on_the_host, shapes_of
from sidestep.tabular.solvers.value_kernels import BOLTZMANN, HARD_MAX, LOG_SUM_EXP, MELLOWMAX
from sidestep.tabular.solvers.values import find_values

KERNELS: dict[type[Backup], int] = {
    HardMax: HARD_MAX,
    BoltzmannAverage: BOLTZMANN,
    LogSumExp: LOG_SUM_EXP,
    Mellowmax: MELLOWMAX,
}
"""The backups that have machine code."""


class GaussSeidel(Solver):
    """Sweeps in the order of distance from where a task ends, one state after another, on the CPU.

    - `tolerance`: relative change at which to stop; by default 1e-10 in 64-bit and 1e-5 in 32-bit numbers.
    - `max_sweeps`: when to give up (and say so): how often a state is solved on average, or after so many rounds over
      all states (see `rounds`).

    For the backups in `KERNELS`; raises `InputError` for another.
    """

    tolerance: Tolerance = None
    max_sweeps: int = eqx.field(default=5_000, static=True)

    def cold_start(self, states: int, dtype: jnp.dtype) -> WarmStart:
        """No values, no adjoint and no order."""
        return WarmStart(jnp.full(states, neg_inf(dtype), dtype), jnp.zeros(states, dtype), _no_order(states))

    def values(
        self, process: DecisionProcess, backup: Backup, beta: Beta, start: WarmStart, region: Region
    ) -> SolveResult:
        """V of the fixed point, of all states where the start's values turn out to be of no use."""
        kind, tie = _machine_code(backup, start.values.dtype)
        # another solver may have left an order of no states
        order = start.order if start.order.shape == start.values.shape else _no_order(len(start.values))
        tolerance = self.tolerance_for(start.values.dtype)
        given = (_fields(process), lower_bound(process), beta, start.values, order, region, tolerance)
        solve = partial(find_values, kind, tie, self.max_sweeps)
        return SolveResult(*on_the_host(solve, given, _shapes_of_sweeps(start.values, order)))

    def vjp(
        self,
        process: DecisionProcess,
        backup: Backup,
        beta: Beta,
        gradient: Gradient,
        values: Float[Array, " states"],
        cotangent: Float[Array, " states"],
        start: WarmStart,
        region: Region,
    ) -> tuple[Cotangents, SolveResult]:
        """The gradient by all that the values depend on, in a share of the time that they took."""
        kind, tie = _machine_code(backup, values.dtype)
        given = (
            _fields(process),
            beta,
            values,
            cotangent,
            start.adjoint,
            start.order,
            region,
            self.tolerance_for(values.dtype),
        )
        by = (process.probabilities, process.reward, process.terminal_reward, process.discount, beta)
        shapes = (shapes_of(by), _shapes_of_sweeps(start.adjoint, start.order))
        solve = partial(vjp, kind, tie, gradient == "exact", self.max_sweeps)
        gradients, found = on_the_host(solve, given, shapes)
        return Cotangents(*gradients), SolveResult(*found)

    def rows(
        self, probabilities: Float[Array, "states actions outcomes"], visited: Int[Array, " visited"]
    ) -> Float[Array, "visited actions outcomes"]:
        """The probabilities of some states, looked up in the array that the host is given anyway.

        The compiler would make all of them a second time to look these up.
        """
        visited = jnp.where(visited < 0, visited + len(probabilities), visited)
        shape = jax.ShapeDtypeStruct((*visited.shape, *probabilities.shape[1:]), probabilities.dtype)
        return on_the_host(look_up, (probabilities, visited), shape)


def _machine_code(backup: Backup, dtype: jnp.dtype) -> tuple[int, float]:
    """The number of a backup, and within which share of the best its ties lie."""
    if type(backup) not in KERNELS:
        known = ", ".join(kind.__name__ for kind in KERNELS)
        raise InputError(f"expected one that has machine code ({known}), or Jacobi() as the solver", field="backup")
    tie = max(backup.tie, 64 * float(jnp.finfo(dtype).eps)) if isinstance(backup, HardMax) else 0.0
    return KERNELS[type(backup)], tie


def _no_order(states: int) -> Array:
    return jnp.full(states, -1, jnp.int32)


def _fields(process: DecisionProcess) -> tuple[Array, ...]:
    """A process as the host takes it (see `given`)."""
    return (
        process.successors,
        process.probabilities,
        process.reward,
        process.terminal_reward,
        process.terminal,
        process.discount,
    )


def _shapes_of_sweeps(values: Array, order: Array) -> tuple[jax.ShapeDtypeStruct, ...]:
    """The shapes of what a solve returns, in the order of `SolveResult`."""
    count = jax.ShapeDtypeStruct((), jax.dtypes.canonicalize_dtype(int))
    residual = jax.ShapeDtypeStruct((), values.dtype)
    return (*shapes_of((values, order)), count, residual, jax.ShapeDtypeStruct((), jnp.dtype(bool)))
