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

from collections.abc import Sequence
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Shaped

from sidestep._arguments import to_integers, to_mask
from sidestep._repr import short_repr
from sidestep.errors import check, check_choice, check_instance, to_count
from sidestep.tabular.arrays import is_traced, to_jax
from sidestep.tabular.backups import Backup, Behavior, Gradient, finite_or_zero
from sidestep.tabular.behavior_model import BehaviorModel, as_behavior_model
from sidestep.tabular.checks import check_behavior, check_model, check_persons, check_task
from sidestep.tabular.implicit import fixed_point
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.proper import check_proper
from sidestep.tabular.solvers import base
from sidestep.tabular.solvers.gauss_seidel import KERNELS, GaussSeidel
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import Task
from sidestep.tabular.wandering import warn_of_wandering

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
        deadline: Whether the horizon is the number of actions in all, so that agents look one action less ahead with
            every action (finite-horizon maximum entropy); by default they look `horizon` ahead at each.
        solver: Computes the fixed point; None for the one that `default_solver` chooses.

    Raises:
        InputError: For another gradient, or a horizon below 1.

    Example:
        >>> SolveOptions(gradient="fixed_policy").horizon is None
        True
    """

    gradient: Gradient = eqx.field(static=True, default="exact")
    horizon: int | None = eqx.field(static=True, default=None)
    deadline: bool = eqx.field(static=True, default=False, kw_only=True)
    solver: base.Solver | None = None

    def __check_init__(self) -> None:
        check_choice(self.gradient, ("exact", "fixed_policy"), "gradient")
        if self.horizon is not None:
            to_count(self.horizon, "horizon")
        check_instance(self.deadline, bool, "deadline")
        check(not self.deadline or self.horizon, "expected a horizon with a deadline, found none", field="horizon")
        check_instance(self.solver, (base.Solver, type(None)), "solver")

    def solver_for(self, backup: Backup, states: int) -> base.Solver:
        """Return `solver`, or without one the default for a problem of that many states.

        Args:
            backup: Of the behavior.
            states: Their number.
        """
        return self.solver or default_solver(backup, states)


@short_repr("values", "action_values", "sweeps", "residual", "error", "converged")
class Solution(eqx.Module):
    """The values of a task under a model, with a leading `tasks` axis for several tasks; made by `solve`.

    Attributes:
        values: V(s); at discount 1, −∞ where no policy surely reaches a terminal state.
        values_after: V of the states that an action leads to, where Q = R + γ Σ T V: `values`, or with a horizon those
            of acting once less.
        action_values: Q(s, a) of all states, or of the `visited` ones; −∞ for actions that are not available, and at
            discount 1 for those that may lead to a state of value −∞.
        advantages: Q(s, a) − V(s), with V from `values_after`, of the same states; summed as differences, they are
            exact where values are far larger than their differences. Policies depend on these.
        sweeps: The number of times that each state was solved, on average; the horizon where it is finite.
        residual: The largest relative change in the last sweep; 0 for a finite horizon.
        error: A bound of |V − V*| in the states that had to be solved, in units of reward; an estimate for the
            Boltzmann average, ∞ where none is known, 0 for a finite horizon.
        converged: Whether the residual is within the solver's tolerance, and the error within the root of this
            tolerance times the largest |V|.
        start: The start of a later solve of the same task under a similar model.

    Example:
        >>> import numpy as np
        >>> from sidestep.tabular.backups import HardMax
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.models import true_model
        >>> from sidestep.tabular.tasks import reach
        >>> grid = Grid(np.zeros((1, 3), dtype=int))
        >>> bool(solve(true_model(grid), reach(grid, 2), Behavior(HardMax())).converged)
        True
    """

    values: Float[Array, "*tasks states"]
    values_after: Float[Array, "*tasks states"]
    action_values: Float[Array, "*tasks visited actions"]
    advantages: Float[Array, "*tasks visited actions"]
    sweeps: Int[Array, "*tasks"]
    residual: Float[Array, "*tasks"]
    error: Float[Array, "*tasks"]
    converged: Bool[Array, "*tasks"]
    start: base.WarmStart


def solve(
    model: TransitionModel,
    task: Task,
    behavior: Behavior | BehaviorModel,
    *,
    options: SolveOptions | None = None,
    start: base.WarmStart | None = None,
    visited: Shaped[ArrayLike, "..."] | Sequence[Any] | None = None,
    times: Shaped[ArrayLike, "..."] | Sequence[Any] | None = None,
    region: Shaped[ArrayLike, "..."] | Sequence[Any] | None = None,
) -> Solution:
    """Return the values of one task, or of a stack of tasks, for agents that behave as `behavior` describes.

    Usable under `jit`, `vmap` and `grad`. The numbers have the dtype of the model's probabilities.

    With the log-sum-exp backup and a discount below 1, agents may avoid their goal because the entropy of going on for
    ever is worth more. Where they arrive less often than by chance, beside every goal, a `SidestepWarning` says so.
    With n actions, no costs and a goal that pays G, that is where G < log(n)/(β (1 − γ)). `sidestep.tabular.wandering`
    has the condition in general. Under `jit` there is no warning.

    Args:
        model: The transition model.
        task: One task, or several by `stack_tasks`.
        behavior: The backup that agents value states with, and their β; a `BehaviorModel` also has a discount, reward
            weights, costs and the β of each task's person.
        options: How the values are computed; by default `SolveOptions()`.
        start: The `start` of an earlier solution of the same task or tasks; by default a cold start. Within the
            region, the solution does not depend on it beyond the tolerance. The gradient with respect to
            `start.adjoint` is the new adjoint λ, which the next solve can start from.
        visited: The states to compute action values of; by default all. Few of them save time and memory where they
            are differentiated.
        times: With a deadline, the number of actions before that in each visited state; by default none.
        region: The states that have to be solved; by default all. `start.region` has those with an adjoint other than
            0 in the earlier solve. `GaussSeidel` updates the others only roughly, to save time. Derivatives are NaN
            where these others are seen to matter, but a state that did not matter before and does now is not noticed:
            use this only where the result is checked later, such as in a line search.

    Returns:
        The solution. Check `converged` before use.

    Raises:
        InputError: For a task of another world, parameters that are NaN, and states or times that do not exist.
        ImproperTask: For a task without values (see `check_proper`). Under `jit` this is not checked.

    Example:
        >>> import numpy as np
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
    options = SolveOptions() if options is None else options
    check_instance(options, SolveOptions, "options")
    check_model(model)
    check_task(task, model.graph)
    check_behavior(behavior, model.graph)
    agents = as_behavior_model(behavior)
    if task.terminal.ndim == 2:
        check_persons(behavior, len(task.terminal))
    check_instance(start, (base.WarmStart, type(None)), "start")
    visited, times, region = _checked_states(task, options, visited, times, region)
    if not is_traced(model, task, behavior):
        check_proper(task, behavior, model.graph, options.horizon)
    solution = _solve(model, task, agents, options, start, visited, times, region)
    if options.horizon is None and region is None and not is_traced(model, task, behavior, solution.values):
        warn_of_wandering(model, task, agents, solution.values, solution.converged)
    return solution


def _checked_states(
    task: Task, options: SolveOptions, visited: object | None, times: object | None, region: object | None
) -> tuple[Array | None, Array | None, Array | None]:
    """Return the states to look at, their times and the region as arrays; refuse those that do not exist."""
    *tasks, states = task.terminal.shape
    if visited is not None:
        axes = (*tasks, "visited")
        visited = to_jax(to_integers(visited, "visited", axes, least=0, most=states - 1, what="states"))
    if times is not None:
        message = "expected none without visited states and a deadline (`SolveOptions(horizon=…, deadline=True)`)"
        check(visited is not None and options.deadline, message, field="times")
        shape = () if visited is None else visited.shape
        times = to_jax(to_integers(times, "times", shape, least=0, most=(options.horizon or 1) - 1))
    return visited, times, None if region is None else to_jax(to_mask(region, "region", (*tasks, states)))


# Compiled as a whole: otherwise every call would compile the loops of a solver again.
@eqx.filter_jit
def _solve(
    model: TransitionModel,
    task: Task,
    agents: BehaviorModel,
    options: SolveOptions,
    start: base.WarmStart | None,
    visited: Int[Array, "*tasks visited"] | None,
    times: Int[Array, "*tasks visited"] | None,
    region: Bool[Array, "*tasks states"] | None,
) -> Solution:
    task, behavior = agents.tasks_of(task), agents.behavior_of()
    solver = options.solver_for(behavior.backup, model.graph.states)
    probabilities = model.probabilities()
    dtype = probabilities.dtype
    cold, tasks = solver.cold_start(model.graph.states, dtype), task.terminal.shape[:-1]
    begin = start or jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*tasks, *leaf.shape)), cold)
    everywhere = jnp.ones(task.terminal.shape, dtype=bool) if region is None else region
    betas = agents.betas(*tasks).astype(dtype) if tasks else behavior.beta.astype(dtype)

    def one(
        task: Task, start: base.WarmStart, visited: Array | None, times: Array | None, region: Array, beta: Array
    ) -> Solution:
        process = decision_process(model, probabilities, task)
        some = jnp.zeros(0, jnp.int32) if visited is None else visited
        if options.horizon is None:
            equation = base.BellmanEquation(process, behavior.backup, beta)
            inputs, fixed = equation.inputs, jax.lax.stop_gradient((equation.inputs, start))
            result = solver.values(equation.at(fixed[0]), fixed[1], region)
            structure = process.successors, process.terminal, process.available
            constants = (*structure, solver, result.order, region, some)
            solved = fixed_point(behavior.backup, options.gradient, constants, inputs, result.values, start.adjoint)
            values, rows = cast(tuple[Array, Array], solved)
            after, later = values, values[None]
        else:
            rules = behavior.backup, beta, options.horizon, options.gradient
            values, later = base.finite_horizon(process, *rules)
            after = later[0]
            sweeps, none = jnp.asarray(options.horizon), jnp.asarray(0, values.dtype)
            result = base.SolveResult(values, start.order, sweeps, none, none, jnp.isfinite(values).all())
            rows = probabilities[some]
        if visited is None:
            here, advantages = after, process.advantages(after)
        else:
            parts = process.reward, process.available
            reward, available = (part[visited] if len(part) > 1 else part for part in parts)
            time = jnp.zeros_like(visited) if times is None else times
            here, leads_to = later[time, visited], later[time[:, None, None], process.successors[visited]]
            advantages = base.advantages(here, leads_to, rows, reward, available, process.discount)
        q = finite_or_zero(here)[:, None] + advantages
        next_start = base.WarmStart(jax.lax.stop_gradient(values), start.adjoint, result.order)
        info = result.sweeps, result.residual, result.error, result.converged
        return Solution(values, after, q, advantages, *info, next_start)

    return (jax.vmap(one) if tasks else one)(task, begin, visited, times, everywhere, betas)


def expected_reward(
    reward: Float[Array, "#states #actions"],
    outcome_reward: Float[Array, "#states #actions #outcomes"] | None,
    probabilities: Float[Array, "states actions outcomes"],
) -> Float[Array, "#states #actions"]:
    """Return R(s, a) + Σ_s′ T(s, a, s′) R(s, a, s′), in units of reward.

    Args:
        reward: R(s, a).
        outcome_reward: R(s, a, s′) of each outcome; None for none.
        probabilities: T of each outcome.
    """
    if outcome_reward is None:
        return reward
    return reward + jnp.sum(probabilities * outcome_reward.astype(probabilities.dtype), axis=-1)


def decision_process(
    model: TransitionModel, probabilities: Float[Array, "states actions outcomes"], task: Task
) -> base.DecisionProcess:
    """Return one task under a model with these probabilities, in numbers of their dtype.

    Its rewards are the expected ones, R(s, a) + Σ_s′ T(s, a, s′) R(s, a, s′), with the gradient by the probabilities.

    Args:
        model: The transition model.
        probabilities: Its probabilities.
        task: One task.
    """
    cast = (leaf.astype(probabilities.dtype) for leaf in (task.reward, task.terminal_reward, task.discount))
    reward, terminal_reward, discount = cast
    reward = expected_reward(reward, task.outcome_reward, probabilities)
    structure = task.terminal, model.graph.available
    return base.DecisionProcess(model.graph.successors, probabilities, reward, terminal_reward, *structure, discount)
