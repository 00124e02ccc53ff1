"""Values of a task under a model, differentiable by the implicit function theorem (adjoint method).

The values solve the Bellman equation V = F(V, φ), where F is one backup and φ are the probabilities, rewards, discount
and β. A scalar with gradient g with respect to V has gradient λᵀ ∂F/∂φ with respect to φ, where λ solves the adjoint
equation λ = g + (∂F/∂V)ᵀ λ. One adjoint solve serves any number of parameters, so a gradient costs about as much as the
values. This differs from the textbook method in two points:

1. With `gradient="fixed_policy"`, ∂F is that of the average under the policy held fixed (eqs. 7, 9 and 10). With the
   Boltzmann average that is not the gradient of any function.
2. An adjoint that does not converge gives a gradient of NaN, never a wrong one.

`sidestep.tabular.solvers.base` has the equations that solvers solve.
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
from sidestep.tabular.solvers import base
from sidestep.tabular.solvers.gauss_seidel import KERNELS, GaussSeidel
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import Task

SMALL_PROBLEM = 400
"""The number of states below which `Jacobi` is at least as fast as `GaussSeidel` on a CPU (`benchmarks/scaling.py`)."""


def default_solver(backup: Backup, states: int) -> base.Solver:
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
    solver: base.Solver | None = None

    def __check_init__(self) -> None:
        if self.gradient not in ("exact", "fixed_policy"):
            raise InputError(f"expected 'exact' or 'fixed_policy', found {self.gradient!r}", field="gradient")
        if self.horizon is not None and self.horizon < 1:
            raise InputError(f"expected at least one action, found {self.horizon}", field="horizon")

    def solver_for(self, backup: Backup, states: int) -> base.Solver:
        """Return `solver`, or without one the default for a problem of that many states.

        Args:
            backup: of the behavior.
            states: their number.
        """
        return self.solver or default_solver(backup, states)


class Solution(eqx.Module):
    """The values of a task under a model, with a leading `tasks` axis for several tasks; made by `solve`.

    Attributes:
        values: V(s); at discount 1, near `solvers.base.neg_inf` (for −∞) where no terminal state can be reached.
        action_values: Q(s, a) of all states, or of the `visited` ones.
        sweeps: the number of times that each state was solved, on average; the horizon where it is finite.
        residual: the largest relative change in the last sweep; 0 for a finite horizon.
        converged: whether the residual is within the solver's tolerance.
        start: the start of a later solve of the same task under a similar model.
    """

    values: Float[Array, "*tasks states"]
    action_values: Float[Array, "*tasks visited actions"]
    sweeps: Int[Array, "*tasks"]
    residual: Float[Array, "*tasks"]
    converged: Bool[Array, "*tasks"]
    start: base.WarmStart


def solve(
    model: TransitionModel,
    task: Task,
    behavior: Behavior,
    *,
    options: SolveOptions | None = None,
    start: base.WarmStart | None = None,
    visited: Int[Array, "*tasks visited"] | None = None,
    region: Bool[Array, "*tasks states"] | None = None,
) -> Solution:
    """Return the values of one task, or of a stack of tasks, for agents that behave as `behavior` describes.

    Usable under `jit`, `vmap` and `grad`. The numbers have the dtype of the model's probabilities.

    Args:
        model: the transition model.
        task: one task, or several by `stack_tasks`.
        behavior: the backup that agents value states with, and their β.
        options: how the values are computed; by default `SolveOptions()`.
        start: the `start` of an earlier solution of the same task or tasks; by default a cold start. Within the
            region, the solution does not depend on it beyond the tolerance. The gradient with respect to
            `start.adjoint` is the new adjoint λ, which the next solve can start from.
        visited: the states to compute action values of; by default all. Few of them save time and memory where they
            are differentiated.
        region: the states that have to be solved; by default all. `start.region` has those with an adjoint other than
            0 in the earlier solve. `GaussSeidel` updates the others only roughly, to save time. Derivatives are NaN
            where these others are seen to matter, but a state that did not matter before and does now is not noticed:
            use this only where the result is checked later, such as in a line search.

    Returns:
        The solution. Check `converged` before use; `check_proper` tells in advance whether values exist.

    Example:
        >>> from sidestep.tabular.backups import HardMax
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.models import true_model
        >>> from sidestep.tabular.tasks import reach
        >>> grid = Grid(np.zeros((1, 3), dtype=int))
        >>> solve(true_model(grid), reach(grid, 2, discount=0.5), Behavior(HardMax())).values.tolist()
        [0.25, 0.5, 1.0]

    References:
        Equations 2-5 (values) and 7-10 (gradients) of the behavior-aware modeling paper. The adjoint method for fixed
        points: Christianson, "Reverse accumulation and attractive fixed points" (1994).
    """
    return _solve(model, task, behavior, options or SolveOptions(), start, visited, region)


# Compiled as a whole: otherwise every call would compile the loops of a solver again.
@eqx.filter_jit
def _solve(
    model: TransitionModel,
    task: Task,
    behavior: Behavior,
    options: SolveOptions,
    start: base.WarmStart | None,
    visited: Int[Array, "*tasks visited"] | None,
    region: Bool[Array, "*tasks states"] | None,
) -> Solution:
    solver = options.solver_for(behavior.backup, model.graph.states)
    probabilities = model.probabilities()
    dtype = probabilities.dtype
    behavior = eqx.tree_at(lambda agent: agent.beta, behavior, behavior.beta.astype(dtype))

    begin = start or _cold_start(solver, model.graph.states, dtype, task.terminal.shape[:-1])
    everywhere = jnp.ones(task.terminal.shape, dtype=bool) if region is None else region

    def one(task: Task, start: base.WarmStart, visited: Array | None, region: Array) -> Solution:
        process = base.DecisionProcess(
            model.graph.successors,
            probabilities,
            task.reward.astype(dtype),
            task.terminal_reward.astype(dtype),
            task.terminal,
            task.discount.astype(dtype),
        )
        some = jnp.zeros(0, jnp.int32) if visited is None else visited
        if options.horizon is None:
            equation = base.BellmanEquation(process, behavior.backup, behavior.beta)
            result, rows = _solve_fixed_point(equation, options.gradient, solver, start, some, region)
        else:
            values = base.finite_horizon(process, behavior.backup, behavior.beta, options.horizon, options.gradient)
            sweeps, residual = jnp.asarray(options.horizon), jnp.asarray(0, values.dtype)
            result = base.SolveResult(values, start.order, sweeps, residual, jnp.isfinite(values).all())
            rows = probabilities[some]
        values = result.values
        if visited is None:
            q = process.action_values(values)
        else:
            reward = process.reward[visited] if len(process.reward) > 1 else process.reward
            after = values[process.successors[visited]]
            q = base.action_values(values[visited], after, rows, reward, process.discount)
        next_start = base.WarmStart(jax.lax.stop_gradient(values), start.adjoint, result.order)
        return Solution(values, q, result.sweeps, result.residual, result.converged, next_start)

    arguments = task, begin, visited, everywhere
    return jax.vmap(one)(*arguments) if task.terminal.ndim == 2 else one(*arguments)


def _cold_start(solver: base.Solver, states: int, dtype: jnp.dtype, tasks: tuple[int, ...]) -> base.WarmStart:
    cold = solver.cold_start(states, dtype)
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*tasks, *leaf.shape)), cold)


def check_proper(task: Task, behavior: Behavior, actions: int, horizon: int | None = None) -> None:
    """Check that the values of every task are finite and unique.

    Tasks with a finite horizon or a discount below 1 are proper. At discount 1 a task needs a terminal state and every
    action must have a cost; with the log-sum-exp backup one above log(actions)/β, the entropy bonus of an action, as
    agents otherwise gain by never arriving.

    Args:
        task: one task or a stack.
        behavior: of the agents.
        actions: the number of actions.
        horizon: as in `SolveOptions`.

    Raises:
        ImproperTask: where they are not.

    Example:
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.tasks import reach
        >>> goal = reach(Grid.unknown(2, 2), 0, discount=1.0, step_cost=1.0)
        >>> check_proper(goal, Behavior(LogSumExp(), beta=10.0), actions=4)
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
        raise ImproperTask(
            "at discount 1 every action must cost something: expected rewards below 0, a discount below 1 (.99, say), "
            "or for tasks of few actions `SolveOptions(horizon=…)`"
        )
    bonus = np.log(actions) / float(behavior.beta)
    if isinstance(behavior.backup, LogSumExp) and (endless & (acting >= -bonus)).any():
        raise ImproperTask(
            f"at discount 1 a log-sum-exp agent with β = {float(behavior.beta):g} and {actions} actions gains "
            f"log(actions)/β = {bonus:.4g} with every action and never wants to arrive: expected a step cost "
            "above that, a larger β, a discount below 1 or another backup"
        )


def _solve_fixed_point(
    equation: base.BellmanEquation,
    gradient: Gradient,
    solver: base.Solver,
    start: base.WarmStart,
    visited: Int[Array, " visited"],
    region: base.Region,
) -> tuple[base.SolveResult, Float[Array, "visited actions outcomes"]]:
    inputs, process, backup = equation.inputs, equation.process, equation.backup
    result = solver.values(equation.at(jax.lax.stop_gradient(inputs)), jax.lax.stop_gradient(start), region)
    constants = (process.successors, process.terminal, solver, result.order, region, visited)
    solved: tuple[Array, Array] = _implicit(backup, gradient, constants, inputs, result.values, start.adjoint)
    return result._replace(values=solved[0]), solved[1]


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _implicit(
    backup: Backup,
    gradient: Gradient,
    constants: tuple,
    inputs: base.Cotangents,
    values: base.Values,
    adjoint: base.Values,
) -> tuple[base.Values, Float[Array, "visited actions outcomes"]]:
    """Return the solution V of V = F(V, φ), φ = `inputs`, with its gradient by the adjoint equation.

    Also return the probabilities of the visited states. Their gradient is added in place to the one by the values: two
    arrays of the model's size would take longer to make and to add than most of the rest.

    `adjoint` is where the solve of the adjoint starts. It has no influence, so its gradient is free to carry the new
    adjoint out of the backward pass.
    """
    del backup, gradient, adjoint
    solver, visited = constants[2], constants[-1]
    return values, solver.gather_rows(inputs.probabilities, visited)


def _implicit_forward(
    backup: Backup, gradient: Gradient, constants: tuple, inputs: base.Cotangents, values: Array, adjoint: Array
):
    outputs = _implicit(backup, gradient, constants, inputs, values, adjoint)
    return outputs, (constants, inputs, values, adjoint)


def _implicit_backward(backup: Backup, gradient: Gradient, saved: tuple, cotangents: tuple[Array, Array]):
    (successors, terminal, solver, order, region, visited), inputs, values, adjoint = saved
    probabilities, reward, terminal_reward, discount, beta = inputs
    process = base.DecisionProcess(successors, probabilities, reward, terminal_reward, terminal, discount)
    equation, start = base.BellmanEquation(process, backup, beta), base.WarmStart(values, adjoint, order)
    cotangent, result = solver.vjp(equation, gradient, cotangents[0], start, region)
    cotangent = cotangent._replace(probabilities=cotangent.probabilities.at[visited].add(cotangents[1]))
    return None, cotangent, jnp.zeros_like(values), result.values


_implicit.defvjp(_implicit_forward, _implicit_backward)
