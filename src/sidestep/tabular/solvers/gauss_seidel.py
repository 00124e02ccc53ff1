"""Gauss–Seidel value iteration in order of distance, with a local Newton step, as native code on the CPU.

The textbook method (Bertsekas & Tsitsiklis, *Parallel and Distributed Computation*, 1989, section 4.3) sweeps over the
states and replaces one value after another by its backup. This one differs:

1. States are swept in order of their distance from where the task ends (`ordering`), as in Dijkstra's algorithm. A warm
   start brings its order along.
2. Each state's own equation is solved by a Newton step instead of a backup, so that actions that mostly fail do not
   slow the sweeps down (`base`).
3. Values of farther states are shifted along with those they depend on, and states with unchanged neighbors are
   skipped (`value_kernels`).
4. Sweeps go block by block, each until it has converged (`sweep_loop`).
5. Worlds of up to a thousand states in which some hundred sweeps do not suffice are left to `Jacobi`, which has direct
   steps.
6. The gradient is that of the fixed point, by the adjoint equation; this is solved in the reverse order (`adjoint`).

This module is what JAX sees. The rest runs on the host, and is imported when it first runs.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sidestep.errors import InputError, to_count
from sidestep.tabular.backups import Backup, BoltzmannAverage, Gradient, HardMax, LogSumExp, Mellowmax
from sidestep.tabular.solvers import base, native
from sidestep.tabular.solvers.base import BellmanEquation, Region, Values, WarmStart
from sidestep.tabular.solvers.bounds import lower_bound, move_costs
from sidestep.tabular.solvers.direct import MOST_STATES, sweeps_before
from sidestep.tabular.solvers.jacobi import Jacobi

KERNELS: dict[type[Backup], int] = {
    HardMax: native.HARD_MAX,
    BoltzmannAverage: native.BOLTZMANN,
    LogSumExp: native.LOG_SUM_EXP,
    Mellowmax: native.MELLOWMAX,
}
"""The backups that have native code, and their numbers."""


class GaussSeidel(base.Solver):
    """Gauss–Seidel value iteration in order of distance, on the CPU, for the backups in `KERNELS`.

    Attributes:
        tolerance: The relative change at which to stop, from 0; by default 1e-10 in 64-bit and 1e-5 in 32-bit numbers.
        max_sweeps: When to stop without convergence: the number of times that a state is solved on average, and of
            rounds over all states; at least 1.
        max_region_sweeps: The same for an adjoint where states were left out of the values' solve: residuals may go
            round in circles there for long. At least 1.

    Raises:
        InputError: For a tolerance below 0 and fewer sweeps than 1; when it solves, for a backup without native code.

    Example:
        >>> import sidestep as ss
        >>> grid = ss.Grid.unknown(30, 30)
        >>> options = ss.SolveOptions(solver=ss.GaussSeidel(tolerance=1e-6))
        >>> solution = ss.solve(ss.ObstacleGrid(grid), ss.reach(grid, 0), ss.Behavior(ss.HardMax()), options=options)
        >>> bool(solution.converged)
        True

    References:
        Bertsekas & Tsitsiklis, *Parallel and Distributed Computation: Numerical Methods* (1989), section 4.3.
    """

    tolerance: base.Tolerance = None
    max_sweeps: int = eqx.field(default=5_000, static=True)
    max_region_sweeps: int = eqx.field(default=100, static=True)

    def __check_init__(self) -> None:
        self.check_settings()
        to_count(self.max_region_sweeps, "max_region_sweeps")

    def cold_start(self, states: int, dtype: jnp.dtype) -> WarmStart:
        """Return a start without values, adjoint and order."""
        return WarmStart(jnp.full(states, -jnp.inf, dtype), jnp.zeros(states, dtype), _no_order(states))

    def values(self, equation: BellmanEquation, start: WarmStart, region: Region) -> base.SolveResult:
        """Return V of the fixed point; of all states where the start's values turn out to be of no use."""
        # another solver may have left an order of no states
        order = start.order if start.order.shape == start.values.shape else _no_order(len(start.values))
        process, backup, beta = equation
        limits = lower_bound(process), move_costs(process, backup, beta)
        arguments = (self._native_equation(equation), *limits, start._replace(order=order), region)
        states, dtype = start.values.shape[0], start.values.dtype
        is_small = states <= MOST_STATES
        most = min(self.max_sweeps, sweeps_before(states)) if is_small else self.max_sweeps
        result = native.call_host(partial(_solve_values, most), arguments, _result_shapes(start.values, order))
        if not is_small:
            return result
        # direct steps, where sweeps are slow
        rest = Jacobi(self.tolerance_for(dtype), self.max_sweeps)
        return rest.go_on(equation, WarmStart(result.values, start.adjoint, result.order), result)

    def vjp(
        self, equation: BellmanEquation, gradient: Gradient, cotangent: Values, start: WarmStart, region: Region
    ) -> tuple[base.Cotangents, base.SolveResult]:
        """Return the gradient by all that the values depend on; it takes a fraction of the time that they took."""
        arguments = (self._native_equation(equation), start, cotangent, region)
        shapes = (native.shapes_of(equation.inputs), _result_shapes(start.adjoint, start.order))
        by_adjoint = partial(_pull_back, gradient == "exact", self.max_sweeps, self.max_region_sweeps)
        return native.call_host(by_adjoint, arguments, shapes)

    def gather_rows(
        self, probabilities: Float[Array, "states actions outcomes"], visited: Int[Array, " visited"]
    ) -> Float[Array, "visited actions outcomes"]:
        """Return the probabilities of some states, from the array that the host has anyway.

        The compiler would compute all of them a second time.
        """
        visited = jnp.where(visited < 0, visited + len(probabilities), visited)
        shape = jax.ShapeDtypeStruct((*visited.shape, *probabilities.shape[1:]), probabilities.dtype)
        return native.call_host(_take_rows, (probabilities, visited), shape)

    def _native_equation(self, equation: BellmanEquation) -> native.NativeEquation:
        process, backup, beta = equation
        if type(backup) not in KERNELS:
            known = ", ".join(kind.__name__ for kind in KERNELS)
            raise InputError(f"expected one that has native code ({known}), or Jacobi() as the solver", field="backup")
        dtype = process.probabilities.dtype
        tie = max(backup.tie, 64 * float(jnp.finfo(dtype).eps)) if isinstance(backup, HardMax) else 0.0
        beta, tolerance = jax.tree.map(lambda number: jnp.asarray(number, dtype), (beta, self.tolerance_for(dtype)))
        native_backup = native.NativeBackup(KERNELS[type(backup)], beta, dtype.type(tie))
        return native.NativeEquation(native.HostProcess(*jax.tree.leaves(process)), native_backup, tolerance)


def _solve_values(*arguments: Any) -> None:
    from sidestep.tabular.solvers.values import solve_values

    solve_values(*arguments)


def _pull_back(*arguments: Any) -> None:
    from sidestep.tabular.solvers.adjoint import vjp_of_process

    vjp_of_process(*arguments)


def _take_rows(into: np.ndarray, probabilities: np.ndarray, states: np.ndarray) -> None:
    np.take(probabilities, states, axis=0, out=into, mode="clip")


def _no_order(states: int) -> Array:
    return jnp.full(states, -1, jnp.int32)


def _result_shapes(values: Array, order: Array) -> Any:
    """Return a `SolveResult` of shapes."""
    types = jax.dtypes.canonicalize_dtype(int), values.dtype, values.dtype, jnp.dtype(bool)
    info = [jax.ShapeDtypeStruct((), dtype) for dtype in types]
    return base.SolveResult(*native.shapes_of((values, order)), *info)
