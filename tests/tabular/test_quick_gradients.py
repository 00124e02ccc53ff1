"""Values and gradients of both solvers in small worlds, beside differentiated plain value iteration."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.problems import BACKUPS, PROBLEMS, generic_task, plain_values
from sidestep.tabular.backups import Behavior
from sidestep.tabular.solve import SolveOptions, solve
from sidestep.tabular.solvers.gauss_seidel import GaussSeidel
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import Task

BETA, ENOUGH = 4.0, 400
SOLVERS = {"jacobi": Jacobi(), "gauss_seidel": GaussSeidel()}
CASES = [
    ("tabular", "Boltzmann", 0.9),
    ("tabular", "mellowmax", 1.0),
    ("4-connected", "log-sum-exp", 1.0),
    ("8-connected", "Boltzmann", 0.9),
    ("4-connected", "hard max", 0.9),
]


def functional(values, q):
    """A sum of all values and action values with weights of all signs."""
    rng = np.random.default_rng(7)
    return jnp.sum(rng.normal(size=values.shape) * values) + jnp.sum(rng.normal(size=q.shape) * q)


def inputs_of(graph, discount):
    problem = PROBLEMS[graph]
    task = generic_task(problem, discount)
    return (
        problem,
        task,
        (problem.model.parameters, jnp.asarray(BETA), task.reward, task.terminal_reward, task.discount),
    )


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(("graph", "name", "discount"), CASES)
def test_solve_and_its_gradient_equal_plain_value_iteration(graph, name, discount, solver):
    problem, task, inputs = inputs_of(graph, discount)

    def solved(parameters, beta, reward, final, gamma):
        made = Task(reward, final, task.terminal, gamma)
        model, agents = problem.model.with_parameters(parameters), Behavior(BACKUPS[name], beta)
        solution = solve(model, made, agents, options=SolveOptions(solver=SOLVERS[solver]))
        return functional(solution.values, solution.action_values)

    def plain(parameters, beta, reward, final, gamma):
        made = Task(reward, final, task.terminal, gamma)
        return functional(*plain_values(name, problem.dense(parameters), made, beta, ENOUGH))

    every = tuple(range(len(inputs)))
    value, gradients = jax.jit(jax.value_and_grad(solved, every))(*inputs)
    expected, references = jax.jit(jax.value_and_grad(plain, every))(*inputs)
    assert float(value) == pytest.approx(float(expected), rel=1e-8)
    for gradient, reference in zip(gradients, references, strict=True):
        scale = np.abs(reference).max()
        np.testing.assert_allclose(gradient, reference, rtol=1e-6, atol=1e-7 * max(float(scale), 1.0))


@pytest.mark.parametrize("solver", SOLVERS)
def test_solve_tells_how_it_went(solver):
    """The residual is the largest change that one more plain backup makes, relative to the values."""
    problem, task, _ = inputs_of("tabular", 0.9)
    solution = solve(
        problem.model, task, Behavior(BACKUPS["Boltzmann"], BETA), options=SolveOptions(solver=SOLVERS[solver])
    )
    transitions = problem.dense(problem.model.parameters)
    values, q = plain_values("Boltzmann", transitions, task, BETA, ENOUGH)
    np.testing.assert_allclose(solution.values, values, rtol=1e-8)
    np.testing.assert_allclose(solution.action_values, q, rtol=1e-8)
    assert bool(solution.converged)
    assert 1 < int(solution.sweeps) < ENOUGH
    assert 0 <= float(solution.residual) < 1e-8
    few = SolveOptions(solver=type(SOLVERS[solver])(max_sweeps=2))
    short = solve(problem.model, task, Behavior(BACKUPS["Boltzmann"], BETA), options=few)
    assert not bool(short.converged)
    assert int(short.sweeps) <= 2


@pytest.mark.parametrize("name", BACKUPS)
@pytest.mark.parametrize("horizon", [1, 2, 5])
def test_solve_with_a_horizon_looks_as_many_actions_ahead(name, horizon):
    problem, task, _ = inputs_of("tabular", 1.0)
    solution = solve(problem.model, task, Behavior(BACKUPS[name], BETA), options=SolveOptions(horizon=horizon))
    values, q = plain_values(name, problem.dense(problem.model.parameters), task, BETA, horizon)
    np.testing.assert_allclose(solution.values, values, rtol=1e-10)
    np.testing.assert_allclose(solution.action_values, q, rtol=1e-10)


@pytest.mark.parametrize("solver", SOLVERS)
def test_solve_gradient_by_nothing_is_0_and_by_infinity_is_no_number(solver):
    problem, task, _ = inputs_of("tabular", 0.9)
    agents, options = Behavior(BACKUPS["Boltzmann"], BETA), SolveOptions(solver=SOLVERS[solver])

    @jax.jit
    def gradient(weight):
        def weighted(parameters):
            return weight * solve(problem.model.with_parameters(parameters), task, agents, options=options).values.sum()

        return jax.grad(weighted)(problem.model.parameters)

    assert np.isfinite(gradient(1.0)).all()
    np.testing.assert_array_equal(gradient(0.0), np.zeros_like(problem.model.parameters))
    assert not np.isfinite(gradient(np.inf)).any()
