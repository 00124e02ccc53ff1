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

from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sidestep._repr import short_repr
from sidestep.errors import ImproperTask, check, check_count
from sidestep.tabular.backups import Backup, Behavior, Gradient, LogSumExp
from sidestep.tabular.implicit import fixed_point
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.solvers import base
from sidestep.tabular.solvers.gauss_seidel import KERNELS, GaussSeidel
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import Task

SMALL_PROBLEM = 400
"""The number of states below which `Jacobi` is at least as fast as `GaussSeidel` on a CPU (`benchmarks/scaling.py`)."""


def default_solver(backup: Backup, states: int) -> base.Solver:
    """Return `GaussSeidel` for larger problems on a CPU with a backup that has machine code, `Jacobi` otherwise.

    Args:
        backup: Of the behavior.
        states: Their number.
    """
    if jax.default_backend() == "cpu" and states >= SMALL_PROBLEM and type(backup) in KERNELS:
        return GaussSeidel()
    return Jacobi()


class SolveOptions(eqx.Module):
    """How values are computed and what their derivatives mean; shared by `solve`, `log_likelihood`, `plan` and `fit`.

    Attributes:
        gradient: "exact", or "fixed_policy" for the derivative of the average under the policy held fixed (eqs. 9, 10).
        horizon: The number of actions that agents look ahead, at least 1; None for the fixed point of the Bellman
            equation.
        solver: Computes the fixed point; None for the one that `default_solver` chooses.

    Raises:
        InputError: For another gradient, or a horizon below 1.

    Example:
        >>> SolveOptions(gradient="fixed_policy").horizon is None
        True
    """

    gradient: Gradient = eqx.field(static=True, default="exact")
    horizon: int | None = eqx.field(static=True, default=None, converter=lambda n: None if n is None else int(n))
    solver: base.Solver | None = None

    def __check_init__(self) -> None:
        known = self.gradient in ("exact", "fixed_policy")
        check(known, f"expected 'exact' or 'fixed_policy', found {self.gradient!r}", field="gradient")
        if self.horizon is not None:
            check_count(self.horizon, 1, "horizon")

    def solver_for(self, backup: Backup, states: int) -> base.Solver:
        """Return `solver`, or without one the default for a problem of that many states.

        Args:
            backup: Of the behavior.
            states: Their number.
        """
        return self.solver or default_solver(backup, states)


@short_repr("values", "action_values", "sweeps", "residual", "converged")
class Solution(eqx.Module):
    """The values of a task under a model, with a leading `tasks` axis for several tasks; made by `solve`.

    Attributes:
        values: V(s); at discount 1, near `solvers.base.neg_inf` (for −∞) where no terminal state can be reached.
        action_values: Q(s, a) of all states, or of the `visited` ones.
        sweeps: The number of times that each state was solved, on average; the horizon where it is finite.
        residual: The largest relative change in the last sweep; 0 for a finite horizon.
        converged: Whether the residual is within the solver's tolerance.
        start: The start of a later solve of the same task under a similar model.

    Example:
        >>> from sidestep.tabular.backups import HardMax
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.models import true_model
        >>> from sidestep.tabular.tasks import reach
        >>> grid = Grid(np.zeros((1, 3), dtype=int))
        >>> bool(solve(true_model(grid), reach(grid, 2), Behavior(HardMax())).converged)
        True
    """

    values: Float[Array, "*tasks states"]
    action_values: Float[Array, "*tasks visited actions"]
    sweeps: Int[Array, "*tasks"]
    residual: Float[Array, "*tasks"]
    converged: Bool[Array, "*tasks"]
    start: base.WarmStart


# Compiled as a whole: otherwise every call would compile the loops of a solver again.
@eqx.filter_jit
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
        model: The transition model.
        task: One task, or several by `stack_tasks`.
        behavior: The backup that agents value states with, and their β.
        options: How the values are computed; by default `SolveOptions()`.
        start: The `start` of an earlier solution of the same task or tasks; by default a cold start. Within the
            region, the solution does not depend on it beyond the tolerance. The gradient with respect to
            `start.adjoint` is the new adjoint λ, which the next solve can start from.
        visited: The states to compute action values of; by default all. Few of them save time and memory where they
            are differentiated.
        region: The states that have to be solved; by default all. `start.region` has those with an adjoint other than
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
    options = options or SolveOptions()
    solver = options.solver_for(behavior.backup, model.graph.states)
    probabilities = model.probabilities()
    dtype, beta = probabilities.dtype, behavior.beta.astype(probabilities.dtype)
    cold, tasks = solver.cold_start(model.graph.states, dtype), task.terminal.shape[:-1]
    begin = start or jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*tasks, *leaf.shape)), cold)
    everywhere = jnp.ones(task.terminal.shape, dtype=bool) if region is None else region

    def one(task: Task, start: base.WarmStart, visited: Array | None, region: Array) -> Solution:
        process = decision_process(model, probabilities, task)
        some = jnp.zeros(0, jnp.int32) if visited is None else visited
        if options.horizon is None:
            equation = base.BellmanEquation(process, behavior.backup, beta)
            inputs, fixed = equation.inputs, jax.lax.stop_gradient((equation.inputs, start))
            result = solver.values(equation.at(fixed[0]), fixed[1], region)
            constants = (process.successors, process.terminal, solver, result.order, region, some)
            solved = fixed_point(behavior.backup, options.gradient, constants, inputs, result.values, start.adjoint)
            values, rows = cast(tuple[Array, Array], solved)
        else:
            values = base.finite_horizon(process, behavior.backup, beta, options.horizon, options.gradient)
            sweeps, residual = jnp.asarray(options.horizon), jnp.asarray(0, values.dtype)
            result = base.SolveResult(values, start.order, sweeps, residual, jnp.isfinite(values).all())
            rows = probabilities[some]
        if visited is None:
            q = process.action_values(values)
        else:
            reward = process.reward[visited] if len(process.reward) > 1 else process.reward
            after = values[process.successors[visited]]
            q = base.action_values(values[visited], after, rows, reward, process.discount)
        next_start = base.WarmStart(jax.lax.stop_gradient(values), start.adjoint, result.order)
        return Solution(values, q, result.sweeps, result.residual, result.converged, next_start)

    return (jax.vmap(one) if task.terminal.ndim == 2 else one)(task, begin, visited, everywhere)


def decision_process(
    model: TransitionModel, probabilities: Float[Array, "states actions outcomes"], task: Task
) -> base.DecisionProcess:
    """Return one task under a model with these probabilities, in numbers of their dtype.

    Args:
        model: The transition model.
        probabilities: Its probabilities.
        task: One task.
    """
    cast = (leaf.astype(probabilities.dtype) for leaf in (task.reward, task.terminal_reward, task.discount))
    reward, terminal_reward, discount = cast
    return base.DecisionProcess(model.graph.successors, probabilities, reward, terminal_reward, task.terminal, discount)


def check_proper(task: Task, behavior: Behavior, actions: int, horizon: int | None = None) -> None:
    """Check that the values of every task are finite and unique.

    Tasks with a finite horizon or a discount below 1 are proper. At discount 1 a task needs a terminal state and every
    action must have a cost; with the log-sum-exp backup one above log(actions)/β, the entropy bonus of an action, as
    agents otherwise gain by never arriving.

    Args:
        task: One task or a stack.
        behavior: Of the agents.
        actions: The number of actions.
        horizon: As in `SolveOptions`.

    Raises:
        InputError: For a task or behavior of another type.
        ImproperTask: Where values are infinite or not unique.

    Example:
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.tasks import reach
        >>> goal = reach(Grid.unknown(2, 2), 0, discount=1.0, step_cost=1.0)
        >>> check_proper(goal, Behavior(LogSumExp(), beta=10.0), actions=4)
    """
    check(isinstance(task, Task), f"expected a Task, found {type(task).__name__}", field="task")
    check(isinstance(behavior, Behavior), f"expected a Behavior, found {type(behavior).__name__}", field="behavior")
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
            f"log(actions)/β = {bonus:.4g} with every action, so an endless path is worth more than one to the goal: "
            "expected a step cost above that, a larger β, a discount below 1 or another backup"
        )
