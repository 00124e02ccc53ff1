"""Solves of the states that matter only: beside solves of all states, and what leaving states out costs."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.problems import BACKUPS, generic_task, obstacle_problem, relative_error, solve_with
from sidestep.tabular.backups import Behavior
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.solve import SolveOptions, solve
from sidestep.tabular.solvers.base import BellmanEquation, DecisionProcess, Solver, WarmStart
from sidestep.tabular.solvers.gauss_seidel import GaussSeidel
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import reach, stack_tasks
from sidestep.worlds.offices import office

pytestmark = pytest.mark.slow

each_backup = pytest.mark.parametrize("name", BACKUPS)
SOLVER = GaussSeidel(tolerance=1e-9)
TRUTH = office(50, 50, 1)
FREE = np.flatnonzero(TRUTH.known.reshape(-1) == 0)
GOAL = int(FREE[0])
MODEL = ObstacleGrid(TRUTH.forget(), jnp.asarray(np.where(TRUTH.known.reshape(-1) == 1, 4.0, -4.0)))
NEARBY = MODEL.with_parameters(MODEL.parameters + 0.05 * np.sin(np.arange(TRUTH.size)))


def near_the_goal():
    """Visited states: the free cells nearest to the goal, so that much of the map does not matter."""
    values = solve(MODEL, task(), Behavior(BACKUPS["hard max"], 5.0)).values
    return jnp.asarray(FREE[np.argsort(-np.asarray(values)[FREE])[1:30]])


def task():
    return reach(TRUTH.forget(), GOAL, discount=1.0, step_cost=1.0)


@eqx.filter_jit
def likelihood_like(model, behavior, visited, start, region, solver: Solver = SOLVER):
    """A sum over the visited states' action values: (sum, solution), its gradient by the parameters, and λ."""

    def total(parameters, adjoint):
        begin = start._replace(adjoint=adjoint)
        varied, options = model.with_parameters(parameters), SolveOptions(solver=solver)
        solution = solve(varied, task(), behavior, options=options, start=begin, region=region)
        wanted = solution.action_values[visited]
        return jnp.sum(jnp.cos(jnp.arange(wanted.size)) * wanted.ravel()), solution

    return jax.value_and_grad(total, (0, 1), has_aux=True)(model.parameters, start.adjoint)


def all_states():
    return jnp.ones(TRUTH.size, dtype=bool)


def solved_nearby(behavior, visited):
    """What a solve of the model nearby left to start from."""
    cold = SOLVER.cold_start(TRUTH.size, jnp.dtype(jnp.float64))
    (_, solution), (_, adjoint) = likelihood_like(NEARBY, behavior, visited, cold, all_states())
    return solution.start._replace(adjoint=adjoint)


def test_region_without_an_adjoint_is_all_states():
    start = SOLVER.cold_start(3, jnp.dtype(jnp.float64))
    assert start.region.tolist() == [True, True, True]
    assert start._replace(adjoint=jnp.asarray([0.0, -2.0, 1e-30])).region.tolist() == [False, True, True]
    assert start._replace(adjoint=jnp.full(3, jnp.nan)).region.all()
    two = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), start)
    two = two._replace(adjoint=jnp.asarray([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    assert two.region.tolist() == [[True, True, True], [False, True, False]]


@pytest.mark.parametrize("name", [name for name in BACKUPS if name != "hard max"])
def test_solve_with_a_region_gives_the_same_in_fewer_sweeps(name):
    behavior, visited = Behavior(BACKUPS[name], 5.0), near_the_goal()
    start = solved_nearby(behavior, visited)
    region = np.asarray(start.region)
    assert 0 < region.mean() < 0.7
    (whole, solved), (slope, adjoint) = likelihood_like(MODEL, behavior, visited, start, all_states())
    (part, solution), (its_slope, its_adjoint) = likelihood_like(MODEL, behavior, visited, start, start.region)
    assert solution.converged
    assert part == pytest.approx(float(whole), rel=1e-8)
    assert relative_error(its_slope, slope) < 1e-6
    assert relative_error(its_adjoint, adjoint) < 1e-6
    assert solution.sweeps < solved.sweeps
    # the others have moved along, but one sweep is not enough
    behind, before = (jnp.abs(values - solved.values)[~region].mean() for values in (solution.values, start.values))
    assert behind < before / 3
    equations = behavior.backup.value(solution.action_values, behavior.beta) - solution.values
    assert jnp.abs(equations)[~region].max() > 1e-6


def test_solve_from_a_cold_start_ignores_the_region():
    behavior, visited = Behavior(BACKUPS["Boltzmann"], 5.0), near_the_goal()
    cold = SOLVER.cold_start(TRUTH.size, jnp.dtype(jnp.float64))
    (whole, solved), (slope, _) = likelihood_like(MODEL, behavior, visited, cold, all_states())
    for label, region in {"some": solved_nearby(behavior, visited).region, "none": ~all_states()}.items():
        (part, solution), (its_slope, _) = likelihood_like(MODEL, behavior, visited, cold, region)
        np.testing.assert_array_equal(solution.values, solved.values, err_msg=label)
        assert part == whole, label
        assert relative_error(its_slope, slope) < 1e-9, label


def test_solve_with_jacobi_ignores_the_region():
    behavior, visited = Behavior(BACKUPS["Boltzmann"], 5.0), near_the_goal()
    start = solved_nearby(behavior, visited)._replace(order=jnp.zeros(0, jnp.int32))
    solver = Jacobi(tolerance=1e-9)
    (whole, _), (slope, _) = likelihood_like(MODEL, behavior, visited, start, all_states(), solver)
    (part, _), (its_slope, _) = likelihood_like(MODEL, behavior, visited, start, start.region, solver)
    assert part == whole
    np.testing.assert_array_equal(its_slope, slope)


@pytest.mark.filterwarnings("ignore:agents of task . avoid its goal")  # as log-sum-exp agents do at this β
@each_backup
def test_vjp_with_a_region_above_the_tolerance_is_nan(name):
    """λ (B(Q) − V) is by how much a sum over values is wrong; beyond the tolerance there is no gradient."""
    problem, backup, beta = obstacle_problem(4), BACKUPS[name], jnp.asarray(5.0)
    wanted, weights = generic_task(problem, 0.9), jnp.cos(jnp.arange(12))
    left, moved = int(np.flatnonzero(~np.asarray(wanted.terminal))[3]), 1e-4
    right = solve_with(GaussSeidel(tolerance=1e-12), problem.model, wanted, Behavior(backup, beta)).values

    def backed_up(values):
        expected = jnp.einsum("sat,t->sa", problem.dense(problem.model.parameters), values)
        return jnp.where(wanted.terminal, wanted.terminal_reward, backup.value(wanted.reward + 0.9 * expected, beta))

    values = right.at[left].add(moved)
    for _ in range(500):
        values = backed_up(values).at[left].set(right[left] + moved)
    adjoint = jnp.linalg.solve(jnp.eye(12) - jax.jacobian(backed_up)(values).T, weights)
    cost = adjoint[left] * (backed_up(values) - values)[left]
    assert cost == pytest.approx(float(weights @ (right - values)), rel=1e-2)

    process = DecisionProcess(
        problem.model.graph.successors,
        problem.model.probabilities(),
        wanted.reward,
        wanted.terminal_reward,
        wanted.terminal,
        problem.model.graph.available,
        wanted.discount,
    )
    error = float(jnp.abs(cost) / jnp.abs(adjoint * values).sum())
    start = WarmStart(values, jnp.zeros(12), jnp.arange(12, dtype=jnp.int32))
    for tolerance, others, converged in ((1.01, left, True), (0.99, left, False), (0.99, (left + 1) % 12, True)):
        region = jnp.arange(12) != others
        solver = GaussSeidel(tolerance=tolerance * error)
        by, solution = solver.vjp(BellmanEquation(process, backup, beta), "exact", weights, start, region)
        assert bool(solution.converged) == converged
        assert all(bool(jnp.isfinite(part).all()) == converged for part in (*by, solution.values))


def test_solve_gradient_after_too_many_sweeps_with_a_region_is_nan():
    behavior, visited = Behavior(BACKUPS["Boltzmann"], 5.0), near_the_goal()
    start = solved_nearby(behavior, visited)._replace(adjoint=jnp.zeros(TRUTH.size))
    all_but_one = all_states().at[int(FREE[-1])].set(False)
    for most, region, given_up in ((100, all_but_one, False), (1, all_but_one, True), (1, all_states(), False)):
        solver = GaussSeidel(tolerance=1e-9, max_region_sweeps=most)
        (_, solution), (slope, _) = likelihood_like(MODEL, behavior, visited, start, region, solver)
        assert solution.converged
        assert bool(jnp.isnan(slope).all()) == given_up


@pytest.mark.filterwarnings("ignore:agents of task . avoid its goal")  # as log-sum-exp agents do at this β
@pytest.mark.parametrize(("gradient", "dtype"), [("exact", jnp.float64), ("fixed_policy", jnp.float32)])
def test_solve_gradient_in_a_batch_uses_the_region_of_each_task(gradient, dtype):
    """As each by itself; also with a discount below 1."""
    grid, behavior = TRUTH.forget(), Behavior(BACKUPS["log-sum-exp"], 5.0)
    model = MODEL.with_parameters(MODEL.parameters.astype(dtype))
    tasks = stack_tasks(
        [reach(grid, int(FREE[0]), discount=1.0, step_cost=1.0), reach(grid, int(FREE[-1]), discount=0.9)]
    )
    visited = jnp.asarray([FREE[1:6], FREE[-7:-2]])
    solver = GaussSeidel()
    options = SolveOptions(solver=solver, gradient=gradient)

    def total(adjoint, tasks, visited, start, region):
        begin = start._replace(adjoint=adjoint)
        solution = solve(model, tasks, behavior, options=options, start=begin, visited=visited, region=region)
        return jnp.sum(solution.action_values)

    cold = solver.cold_start(TRUTH.size, jnp.dtype(dtype))
    start = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), cold)
    start = solve(model, tasks, behavior, options=options, start=start).start
    adjoint = jax.grad(total)(start.adjoint, tasks, visited, start, jnp.ones_like(start.region))
    start = start._replace(adjoint=adjoint)
    assert 0 < start.region[0].mean() < 0.7
    together = jax.grad(total)(adjoint, tasks, visited, start, start.region)
    for index in range(2):
        one = jax.tree.map(lambda leaf, index=index: leaf[index], (tasks, visited, start, start.region))
        alone = jax.grad(total)(one[2].adjoint, *one)
        np.testing.assert_array_equal(together[index], alone)
        assert relative_error(alone, adjoint[index]) < (1e-6 if dtype == jnp.float64 else 1e-3)
