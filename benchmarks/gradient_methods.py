"""The ways to a gradient that `gradient_peers.py` compares; what each does is said there."""

import argparse
import importlib
from collections.abc import Callable, Mapping
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from scaling import SOLVERS, Problem, take
from sidestep.tabular.backups import BACKUPS, Behavior
from sidestep.tabular.forward_gradients import forward_gradient
from sidestep.tabular.likelihood import choices_of
from sidestep.tabular.models import TabularModel, TransitionModel
from sidestep.tabular.solve import SolveOptions, solve
from sidestep.tabular.solvers.base import DecisionProcess, action_values, at_fixed_policy
from sidestep.tabular.solvers.gauss_seidel import GaussSeidel
from worlds import World

MOST_SWEEPS = 5_000
Parameters = Float[Array, "..."]
Found = tuple[Array, Array]  # a gradient, and how many sweeps it took (0 where that says nothing)


# ---------------------------------------------------------------------------------------------------- the problem


def problem_of(world: World, model: str, backup: str, arguments: argparse.Namespace) -> Problem:
    """The problem in a world, in one parametrisation."""
    cost = None if arguments.goal_pays else arguments.step_cost
    demos = world.demonstrations(arguments.discount, cost)
    people = Behavior(BACKUPS[backup](), arguments.beta)
    made = world.model if model == "cells" else table_of(world.model)
    return Problem(
        made, demos, choices_of(demos), people, GaussSeidel(tolerance=arguments.tolerance), arguments.gradient
    )


def table_of(model: TransitionModel) -> TabularModel:
    """The same probabilities, with a logit for every outcome of every state and action."""
    probabilities = model.probabilities()
    possible = probabilities > 0
    return TabularModel(model.graph, jnp.log(jnp.where(possible, probabilities, 1)), possible)


def process_of(problem: Problem, parameters: Parameters) -> DecisionProcess:
    """The one task under the model at some parameters."""
    model = problem.model.with_parameters(parameters)
    task = jax.tree.map(lambda leaf: leaf[0], problem.demonstrations.tasks)
    probabilities = model.probabilities()
    return DecisionProcess(
        model.graph.successors, probabilities, task.reward, task.terminal_reward, task.terminal, task.discount
    )


def one_backup(problem: Problem, parameters: Parameters, values: Array) -> Array:
    """F(V, θ): one plain backup, with the gradient that is asked for."""
    process, people = process_of(problem, parameters), problem.behavior
    q = process.action_values(values)
    if problem.gradient == "exact":
        return process.end(people.backup.value(q, people.beta))
    return process.end(at_fixed_policy(people.backup, people.beta, q))


def chosen(problem: Problem, parameters: Parameters, values: Array) -> Array:
    """The actions' log-likelihood from the values."""
    model, demos = problem.model.with_parameters(parameters), problem.demonstrations
    states, task = demos.states, jax.tree.map(lambda leaf: leaf[0], demos.tasks)
    after = values[model.graph.successors[states]]
    q = action_values(values[states], after, model.probabilities()[states], task.reward, task.discount)
    return jnp.sum(jnp.take_along_axis(problem.behavior.log_policy(q), demos.actions[:, None], axis=-1))


# ---------------------------------------------------------------------------------------------------- the methods


def values(problem: Problem, parameters: Parameters) -> Found:
    """The values alone."""
    found = solve(
        problem.model.with_parameters(parameters),
        problem.demonstrations.tasks,
        problem.behavior,
        options=SolveOptions(solver=problem.solver),
    )
    return jnp.where(found.converged[0], found.values[0], jnp.nan), found.sweeps[0]


def adjoint(problem: Problem, parameters: Parameters) -> Found:
    """The gradient by the adjoint, from nothing."""
    start = problem.cold_start()
    found = take(problem, parameters, start, start.region)
    return jnp.where(found.converged, found.gradient, jnp.nan), found.sweeps[0]


def plain_values(problem: Problem, parameters: Parameters, sweeps: int) -> Found:
    """Values by so many plain sweeps."""
    start = process_of(problem, parameters).end(jnp.zeros(problem.model.graph.states))
    done = jax.lax.scan(lambda v, _: (one_backup(problem, parameters, v), None), start, length=sweeps)[0]
    return done, jnp.asarray(sweeps)


def unrolled(problem: Problem, parameters: Parameters, sweeps: int) -> Found:
    """The gradient through so many plain sweeps."""

    def objective(parameters: Parameters) -> Array:
        return chosen(problem, parameters, plain_values(problem, parameters, sweeps)[0])

    return jax.grad(objective)(parameters), jnp.asarray(sweeps)


def dense(problem: Problem, parameters: Parameters) -> Found:
    """The gradient by a dense solve of the adjoint equation (I − ∂F/∂V)ᵀ λ = g."""
    solved, sweeps = values(problem, parameters)
    by_parameters, by_values = jax.grad(partial(chosen, problem), argnums=(0, 1))(parameters, solved)
    jacobian = jax.jacobian(partial(one_backup, problem, parameters))(solved)
    multipliers = jnp.linalg.solve((jnp.eye(len(solved)) - jacobian).T, by_values)
    vjp = jax.vjp(lambda x: one_backup(problem, x, solved), parameters)[1]
    return by_parameters + vjp(multipliers)[0], sweeps


def by_optimistix(problem: Problem, parameters: Parameters) -> Found:
    """The gradient by optimistix's fixed point with the adjoint that it has by default."""
    optimistix = importlib.import_module("optimistix")
    start = process_of(problem, parameters).end(jnp.zeros(problem.model.graph.states))
    tolerance = problem.solver.tolerance_for(start.dtype)
    solver = optimistix.FixedPointIteration(rtol=tolerance, atol=tolerance)

    def objective(parameters: Parameters) -> tuple[Array, Array]:
        found = optimistix.fixed_point(
            lambda v, x: one_backup(problem, x, v), solver, start, args=parameters, max_steps=MOST_SWEEPS, throw=False
        )
        return chosen(problem, parameters, found.value), found.stats["num_steps"]

    return jax.grad(objective, has_aux=True)(parameters)


def forward(problem: Problem, parameters: Parameters) -> Found:
    """The gradient by the paper's dynamic program, and how many sweeps it took."""
    model = problem.model.with_parameters(parameters)
    task = jax.tree.map(lambda leaf: leaf[0], problem.demonstrations.tasks)
    options = SolveOptions(gradient=problem.gradient, solver=problem.solver)
    result = forward_gradient(model, task, problem.behavior, options=options, max_sweeps=MOST_SWEEPS)
    flat, unravel = ravel_pytree(parameters)
    likelihood = jax.grad(lambda x, v: chosen(problem, unravel(x), v), argnums=(0, 1))
    by_parameters, by_values = likelihood(flat, result.solution.values)
    return unravel(by_parameters + by_values @ result.value_gradient), result.sweeps


GRADIENTS: Mapping[str, Callable[..., Found]] = {
    "sidestep ordered": adjoint,
    "sidestep jacobi": adjoint,
    "values": values,
    "plain values": plain_values,
    "unrolled": unrolled,
    "dense implicit": dense,
    "optimistix": by_optimistix,
    "forward": forward,
}
BY_SWEEPS = ("plain values", "unrolled")
OTHERS = ("unrolled", "dense implicit", "optimistix", "forward")
ONLY_VALUES = ("values", "plain values")


def method_function(name: str, problem: Problem, sweeps: int) -> tuple[Callable[..., Found], Problem]:
    """What a method computes, and the problem with its solver."""
    function = GRADIENTS[name]
    if name in BY_SWEEPS:
        function = partial(function, sweeps=sweeps)
    if name == "sidestep jacobi":
        solver = SOLVERS["jacobi"](tolerance=problem.solver.tolerance)
        problem = eqx.tree_at(lambda p: p.solver, problem, solver)
    return function, problem
