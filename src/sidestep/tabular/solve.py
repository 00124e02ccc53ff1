"""Values of a task under a model, differentiable with respect to everything that they depend on.

The values solve V = F(V, φ), F one backup and φ all of the probabilities, rewards, discount and β. By the implicit
function theorem a scalar with gradient g with respect to V has gradient λᵀ ∂F/∂φ with respect to φ, where
λ = g + (∂F/∂V)ᵀ λ (the adjoint equation, solved in `sweeps`). One adjoint solve serves any number of parameters, so a
gradient costs about what the values cost. `gradient="fixed_policy"` puts the average under the policy held fixed in the
place of B in ∂F (eqs. 7, 9 and 10); with the Boltzmann average that is not the gradient of any function.

An adjoint that does not converge gives a gradient of NaN, never a wrong one.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sidestep.errors import ImproperTask, InputError
from sidestep.tabular.backups import Backup, Behavior, Gradient, LogSumExp
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.solvers.base import (
    DecisionProcess,
    Region,
    Solver,
    SolveResult,
    WarmStart,
    action_values,
    finite_horizon,
)
from sidestep.tabular.solvers.gauss_seidel import KERNELS, GaussSeidel
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import Task

SMALL_PROBLEM = 400
"""The number of states below which `Jacobi` is at least as fast as `GaussSeidel` on a CPU (`benchmarks/scaling.py`)."""


def default_solver(backup: Backup, states: int) -> Solver:
    """Return `GaussSeidel` for larger problems on a CPU with a backup that has machine code, `Jacobi` otherwise."""
    if jax.default_backend() == "cpu" and states >= SMALL_PROBLEM and type(backup) in KERNELS:
        return GaussSeidel()
    return Jacobi()


class SolveOptions(eqx.Module):
    """How values are computed and what their derivatives mean; shared by `solve`, `log_likelihood`, `plan` and `fit`.

    Attributes:
        gradient: "exact", or "fixed_policy" for the derivative of the average under the policy held fixed (eqs. 9, 10).
        horizon: the number of actions that agents look ahead, at least 1; None for the fixed point of the Bellman
            equation.
        solver: computes the fixed point; None for the one that `default_solver` chooses.

    Raises:
        InputError: for another gradient, or a horizon below 1.

    Example:
        >>> SolveOptions(gradient="fixed_policy").horizon is None
        True
    """

    gradient: Gradient = eqx.field(static=True, default="exact")
    horizon: int | None = eqx.field(static=True, default=None, converter=lambda n: None if n is None else int(n))
    solver: Solver | None = None

    def __check_init__(self):
        if self.gradient not in ("exact", "fixed_policy"):
            raise InputError(f"expected 'exact' or 'fixed_policy', found {self.gradient!r}", field="gradient")
        if self.horizon is not None and self.horizon < 1:
            raise InputError(f"expected at least one action, found {self.horizon}", field="horizon")

    def solver_for(self, backup: Backup, states: int) -> Solver:
        """Return `solver`, or without one the default for a problem of so many states."""
        return self.solver or default_solver(backup, states)


class Solution(eqx.Module):
    """The values of a task under a model, and how the solve went (with a leading `tasks` axis for several tasks).

    - `values`: V(s); at discount 1, states that cannot reach a terminal state are near `process.neg_inf` (for −∞).
    - `action_values`: Q(s, a); of all states, or of those that were asked for.
    - `sweeps`, `residual`, `converged`: see `process.SolveResult`; a finite horizon takes one exact sweep an action.
    - `start`: what a solve of the same task under a model nearby may start from.
    """

    values: Float[Array, "*tasks states"]
    action_values: Float[Array, "*tasks visited actions"]
    sweeps: Int[Array, "*tasks"]
    residual: Float[Array, "*tasks"]
    converged: Bool[Array, "*tasks"]
    start: WarmStart


def solve(
    model: TransitionModel,
    task: Task,
    behavior: Behavior,
    *,
    options: SolveOptions | None = None,
    start: WarmStart | None = None,
    visited: Int[Array, "*tasks visited"] | None = None,
    region: Bool[Array, "*tasks states"] | None = None,
) -> Solution:
    """The values of one task, or of a stack of tasks, for people who behave as `behavior` says under `model`.

    - `options`: how the values are computed; by default `SolveOptions()`.
    - `start`: what an earlier solution of the same task or tasks left; without it, the solve starts from nothing. The
      solution (in the region) does not depend on it beyond the tolerance. Differentiating with respect to
      `start.adjoint` yields the new adjoint λ, for the next solve to start from.
    - `visited`: the states whose action values are wanted; by default all. Asking for few saves time and memory when
      they are differentiated.
    - `region`: the states that have to be solved, by default all; `start.region` are those that mattered to what the
      solve that left the start was asked for. `GaussSeidel` brings the others up to date only roughly, which saves
      time.
      Where they are seen to matter, derivatives are NaN; but a state that did not matter at all and does now goes
      unseen (see `process`). So this is for guesses that are looked at again, like those of a line search.

    The numbers have the dtype of the model's probabilities. May be used under `jit`, `vmap` and `grad`. Look at
    `converged` before you use the numbers; `check_proper` tells beforehand whether values exist.
    """
    return _solve(model, task, behavior, options or SolveOptions(), start, visited, region)


# Compiled as a whole, or else the loops of a solver would be compiled anew with every call.
@eqx.filter_jit
def _solve(
    model: TransitionModel,
    task: Task,
    behavior: Behavior,
    options: SolveOptions,
    start: WarmStart | None,
    visited: Int[Array, "*tasks visited"] | None,
    region: Bool[Array, "*tasks states"] | None,
) -> Solution:
    solver, gradient, horizon = (
        options.solver_for(behavior.backup, model.graph.states),
        options.gradient,
        options.horizon,
    )
    probabilities = model.probabilities()
    dtype = probabilities.dtype
    behavior = eqx.tree_at(lambda people: people.beta, behavior, behavior.beta.astype(dtype))

    begin = start or _cold_start(solver, model.graph.states, dtype, task.terminal.shape[:-1])

    solved = jnp.ones(task.terminal.shape, dtype=bool) if region is None else region

    def one(task: Task, start: WarmStart, visited: Array | None, region: Array) -> Solution:
        process = DecisionProcess(
            model.graph.successors,
            probabilities,
            task.reward.astype(dtype),
            task.terminal_reward.astype(dtype),
            task.terminal,
            task.discount.astype(dtype),
        )
        some = jnp.zeros(0, jnp.int32) if visited is None else visited
        if horizon is None:
            found, rows = _solve_fixed_point(process, behavior, gradient, solver, start, some, region)
        else:
            values = finite_horizon(process, behavior.backup, behavior.beta, horizon, gradient)
            residual = jnp.asarray(0, values.dtype)
            found = SolveResult(values, start.order, jnp.asarray(horizon), residual, jnp.isfinite(values).all())
            rows = probabilities[some]
        values = found.values
        if visited is None:
            q = process.action_values(values)
        else:
            reward = process.reward[visited] if len(process.reward) > 1 else process.reward
            after = values[process.successors[visited]]
            q = action_values(values[visited], after, rows, reward, process.discount)
        left = WarmStart(jax.lax.stop_gradient(values), start.adjoint, found.order)
        return Solution(values, q, found.sweeps, found.residual, found.converged, left)

    arguments = task, begin, visited, solved
    return jax.vmap(one)(*arguments) if task.terminal.ndim == 2 else one(*arguments)


def _cold_start(solver: Solver, states: int, dtype: jnp.dtype, tasks: tuple[int, ...]) -> WarmStart:
    cold = solver.cold_start(states, dtype)
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*tasks, *leaf.shape)), cold)


def check_proper(task: Task, behavior: Behavior, actions: int, horizon: int | None = None) -> None:
    """Raises `ImproperTask` unless the values of every task (one or a stack) are finite and unique.

    A finite horizon or a discount below 1 always is proper. At discount 1 a task must end somewhere and every action
    must cost something; for log-sum-exp people more than log(actions)/β, which is what a choice is worth to them: if it
    costs less they gain by never arriving.
    """
    endless = np.atleast_1d(np.asarray(task.discount)) == 1
    if horizon is not None or not endless.any():
        return
    terminal = np.atleast_2d(np.asarray(task.terminal))
    reward = np.asarray(task.reward).reshape(-1, *task.reward.shape[-2:]).max(axis=-1)
    acting = np.where(terminal, -np.inf, np.broadcast_to(reward, terminal.shape)).max(axis=-1)
    if (endless & ~terminal.any(axis=-1)).any():
        raise ImproperTask("a task with discount 1 needs a terminal state: expected one, or a discount below 1")
    if (endless & (acting >= 0)).any():
        raise ImproperTask("at discount 1 every action must cost something: expected rewards below 0")
    bonus = np.log(actions) / float(behavior.beta)
    if isinstance(behavior.backup, LogSumExp) and (endless & (acting >= -bonus)).any():
        raise ImproperTask(
            f"at discount 1 a log-sum-exp walker with β = {float(behavior.beta):g} and {actions} actions gains "
            f"log(actions)/β = {bonus:.4g} with every action and never wants to arrive: expected a step cost "
            "above that, a larger β, a discount below 1 or another backup"
        )


def _solve_fixed_point(
    process: DecisionProcess,
    behavior: Behavior,
    gradient: Gradient,
    solver: Solver,
    start: WarmStart,
    visited: Int[Array, " visited"],
    region: Region,
) -> tuple[SolveResult, Float[Array, "visited actions outcomes"]]:
    varying = (process.probabilities, process.reward, process.terminal_reward, process.discount, behavior.beta)
    held = jax.lax.stop_gradient(varying)
    given = (process.successors, process.terminal)
    found = solver.values(_process(given, held), behavior.backup, held[-1], jax.lax.stop_gradient(start), region)
    given = (*given, solver, found.order, region, visited)
    solved: tuple[Array, Array] = _implicit(behavior.backup, gradient, given, varying, found.values, start.adjoint)
    return found._replace(values=solved[0]), solved[1]


def _process(given: tuple, varying: tuple) -> DecisionProcess:
    (successors, terminal), (probabilities, reward, terminal_reward, discount, _) = given[:2], varying
    return DecisionProcess(successors, probabilities, reward, terminal_reward, terminal, discount)


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _implicit(
    backup: Backup,
    gradient: Gradient,
    given: tuple,
    varying: tuple,
    values: Float[Array, " states"],
    adjoint: Float[Array, " states"],
) -> tuple[Float[Array, " states"], Float[Array, "visited actions outcomes"]]:
    """`values`, the solution V of V = F(V, φ) with φ = `varying`, with their gradient by the adjoint equation.

    And the visited states' probabilities, whose gradient is added to the one by the values where it is: two arrays of
    the model's size would take longer to make and to add than most of the rest.

    `adjoint` is where the solve of the adjoint starts. It has no influence, so its gradient is free to carry the new
    adjoint out of the backward pass.
    """
    del backup, gradient, adjoint
    solver, visited = given[2], given[-1]
    return values, solver.rows(varying[0], visited)


def _implicit_forward(backup: Backup, gradient: Gradient, given: tuple, varying: tuple, values: Array, adjoint: Array):
    found = _implicit(backup, gradient, given, varying, values, adjoint)
    return found, (given, varying, values, adjoint)


def _implicit_backward(backup: Backup, gradient: Gradient, saved: tuple, cotangents: tuple[Array, Array]):
    given, varying, values, adjoint = saved
    solver, order, region, visited = given[2:]
    process, beta = _process(given, varying), varying[-1]
    start = WarmStart(values, adjoint, order)
    by, found = solver.vjp(process, backup, beta, gradient, values, cotangents[0], start, region)
    by = by._replace(probabilities=by.probabilities.at[visited].add(cotangents[1]))
    return None, tuple(by), jnp.zeros_like(values), found.values


_implicit.defvjp(_implicit_forward, _implicit_backward)
