"""Solves by ordered sweeps: starts, batches, limits. What the sweeps are made of is in `test_sweeps`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.numbered_worlds import some_map
from helpers.problems import BACKUPS, generic_task, obstacle_problem, relative_error, solve_with
from sidestep.errors import InputError
from sidestep.tabular.backups import Behavior, BoltzmannAverage, LogSumExp
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.solve import default_solver
from sidestep.tabular.solvers.gauss_seidel import GaussSeidel
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import reach, stack_tasks
from sidestep.worlds.offices import office

each_backup = pytest.mark.parametrize("name", BACKUPS)
SOLVER = GaussSeidel(tolerance=1e-11)


@eqx.filter_jit
def values_and_slopes(model, wanted, agent, start=None, solver=SOLVER):
    """A solution, and the gradients of a sum over its values by the parameters and by the adjoint to start from."""
    if start is None:
        start = solver.cold_start(model.graph.states, model.probabilities().dtype)

    def total(parameters, adjoint):
        begin = start._replace(adjoint=adjoint)
        solution = solve_with(solver, model.with_parameters(parameters), wanted, agent, start=begin)
        weights = jnp.cos(jnp.arange(solution.values.size)).astype(solution.values.dtype)
        return jnp.sum(weights * solution.values), solution

    slopes, solution = jax.grad(total, (0, 1), has_aux=True)(model.parameters, start.adjoint)
    return solution, *slopes


def agent(name, beta=5.0):
    return Behavior(BACKUPS[name], beta)


# Starts


@pytest.mark.slow
@each_backup
def test_solve_from_any_start_gives_the_same(name):
    """Starts: a model nearby, a wrong order, meaningless values, a failed solve, the solution."""
    model, rng = some_map(), np.random.default_rng(1)
    wanted = reach(model.graph, 5, discount=1.0, step_cost=1.0)
    cold, slope, adjoint = values_and_slopes(model, wanted, agent(name))
    moved = model.with_parameters(model.parameters + 0.1 * rng.normal(size=model.parameters.shape))
    near, _, near_adjoint = values_and_slopes(moved, wanted, agent(name))
    left = near.start._replace(adjoint=near_adjoint)
    noise = jnp.asarray(rng.normal(-10, 10, 420))
    starts = {
        "nearby": left,
        "reversed": left._replace(order=left.order[::-1]),
        "no order": left._replace(order=jnp.zeros_like(left.order)),
        "too high": left._replace(values=jnp.full(420, 1e4), adjoint=noise),
        "unordered noise": left._replace(values=noise, adjoint=noise, order=left.order * 7),
        "failed": left._replace(values=jnp.full(420, jnp.nan), adjoint=jnp.full(420, jnp.nan)),
        "the solution": cold.start._replace(adjoint=adjoint),
    }
    for label, start in starts.items():
        solution, its_slope, its_adjoint = values_and_slopes(model, wanted, agent(name), start)
        assert solution.converged, label
        assert relative_error(solution.values, cold.values) < 1e-8, label
        assert relative_error(its_slope, slope) < 1e-7, label
        assert relative_error(its_adjoint, adjoint) < 1e-7, label
        assert sorted(solution.start.order.tolist()) == list(range(420)), label
    again, _, _ = values_and_slopes(model, wanted, agent(name), starts["the solution"])
    assert again.sweeps <= 2


@pytest.mark.slow
@each_backup
@pytest.mark.parametrize("first", ["none", "all", "few"])
def test_solve_adjoint_from_any_start_solves_its_equation(name, first):
    """λ = g + Wᵀλ, with W dense and its weights by differentiating the backup; whatever λ it starts from."""
    problem = obstacle_problem(4)
    wanted = generic_task(problem, 0.95)
    everywhere = jnp.linspace(-1.0, 1.0, 12)
    adjoints = {"none": jnp.zeros(12), "all": everywhere, "few": jnp.zeros(12).at[jnp.asarray([3, 8])].set(2.0)}
    start = SOLVER.cold_start(12, jnp.dtype(jnp.float64))._replace(adjoint=adjoints[first])
    solution, _, adjoint = values_and_slopes(problem.model, wanted, agent(name), start)
    weights = np.asarray(jax.vmap(jax.grad(BACKUPS[name].value), (0, None))(solution.action_values, jnp.asarray(5.0)))
    transitions = np.asarray(problem.dense(problem.model.parameters))
    matrix = 0.95 * np.einsum("sa,sat->st", weights, transitions) * ~np.asarray(wanted.terminal)[:, None]
    expected = np.linalg.solve(np.eye(12) - matrix.T, np.cos(np.arange(12)))
    np.testing.assert_allclose(adjoint, expected, rtol=1e-8, atol=1e-8)


def test_solve_from_a_start_without_an_order_makes_one():
    """Jacobi leaves no order."""
    model = some_map(4, 5)
    wanted, behavior = reach(model.graph, 5), agent("Boltzmann")
    start = solve_with(Jacobi(), model, wanted, behavior).start
    solution = solve_with(SOLVER, model, wanted, behavior, start=start)
    assert solution.converged
    assert solution.start.order.tolist()[0] == 5


def test_solve_gradient_after_an_earlier_adjoint_leaves_no_traces_of_it():
    """Otherwise states without effect would count as states with one."""
    model = some_map()
    wanted, behavior = reach(model.graph, 5, discount=0.9, step_cost=1.0), agent("hard max")
    start = SOLVER.cold_start(420, jnp.dtype(jnp.float64))

    def of_one_state(adjoint):
        return solve_with(SOLVER, model, wanted, behavior, start=start._replace(adjoint=adjoint)).values[8]

    cold, traces = (jax.grad(of_one_state)(jnp.full(420, size)) for size in (0.0, 1e-30))
    assert 0 < jnp.count_nonzero(cold) < 420
    np.testing.assert_array_equal(traces, cold)


# Batches


@pytest.mark.slow
def test_solve_in_nested_batches_and_loops_equals_each_alone():
    """Over β and over tasks at once, in a scan, in a map: each as by itself."""
    model = some_map(4, 5)
    tasks = stack_tasks([reach(model.graph, goal, discount=0.9) for goal in (0, 7, 19)])
    betas = jnp.asarray([1.0, 10.0])

    def of(parameters, beta, wanted):
        def total(parameters, beta):
            behavior = Behavior(BoltzmannAverage(), beta)
            return jnp.sum(jnp.sin(solve_with(SOLVER, model.with_parameters(parameters), wanted, behavior).values))

        return jax.value_and_grad(total, (0, 1))(parameters, beta)

    one = jax.jit(of)
    single = [one(model.parameters, beta, jax.tree.map(lambda x, i=i: x[i], tasks)) for beta in betas for i in range(3)]
    leaves = zip(*(jax.tree.leaves(each) for each in single), strict=True)
    expected = [jnp.stack(each).reshape(2, 3, *each[0].shape) for each in leaves]
    over_tasks = jax.vmap(of, (None, None, 0))
    transforms = {
        "nested": jax.vmap(over_tasks, (None, 0, None)),
        "map": lambda parameters, betas, tasks: jax.lax.map(lambda beta: over_tasks(parameters, beta, tasks), betas),
        "scan": lambda parameters, betas, tasks: jax.lax.scan(
            lambda carried, beta: (carried, over_tasks(carried, beta, tasks)), parameters, betas
        )[1],
    }
    for name, function in transforms.items():
        solution = jax.tree.leaves(jax.jit(function)(model.parameters, betas, tasks))
        for mine, theirs in zip(solution, expected, strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-12, atol=1e-12, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [GaussSeidel(), Jacobi()], ids=["GaussSeidel", "Jacobi"])
def test_solve_of_32_bit_numbers_stays_in_32_bits(solver):
    problem = obstacle_problem(4)
    inputs = (problem.model, generic_task(problem, 0.9), agent("Boltzmann"))
    exact, exact_slope, _ = values_and_slopes(*inputs)
    narrow = jax.tree.map(lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x, inputs)
    solution, slope, adjoint = values_and_slopes(*narrow, solver=solver)
    arrays = (solution.values, solution.action_values, solution.residual, solution.start.values, slope, adjoint)
    assert {array.dtype for array in arrays} == {jnp.dtype(jnp.float32)}
    assert solution.converged
    assert relative_error(solution.values, exact.values) < 1e-4
    assert relative_error(slope, exact_slope) < 1e-3


# Limits


@pytest.mark.parametrize(("name", "most"), [("Boltzmann", 1), ("Boltzmann", 3)])
def test_solve_with_too_few_sweeps_has_not_converged(name, most):
    model = some_map()
    wanted = reach(model.graph, 5, discount=0.999)
    solver = GaussSeidel(max_sweeps=most, tolerance=1e-14)
    solution, slope, _ = values_and_slopes(model, wanted, agent(name, 0.5), solver=solver)
    assert not solution.converged
    assert jnp.isnan(slope).all()


@pytest.mark.parametrize("where", ["parameters", "reward", "beta"])
def test_solve_with_a_nan_has_not_converged(where):
    model = some_map(4, 5)
    wanted, behavior = reach(model.graph, 5), agent("Boltzmann")
    if where == "parameters":
        model = model.with_parameters(model.parameters.at[3].set(jnp.nan))
    elif where == "reward":
        wanted = eqx.tree_at(lambda task: task.reward, wanted, jnp.full((1, 1), jnp.nan))
    else:
        behavior = eqx.tree_at(lambda agent: agent.beta, behavior, jnp.asarray(jnp.nan))
    solution, slope, _ = values_and_slopes(model, wanted, behavior)
    assert not solution.converged
    assert jnp.isnan(slope).all()


class Sharper(BoltzmannAverage):
    """A backup without native code, though its parent has some."""


def test_solve_of_nearly_closed_cells_converges():
    """Here shifts in every round would make two states cycle."""
    random = np.random.default_rng(78)
    walls, closed = random.random((60, 60)) < 0.3, random.random((60, 60)) < 0.1
    grid = Grid(np.where(closed, -1, walls.astype(int)))
    goal = reach(grid, int(np.flatnonzero(grid.known == 0)[0]), discount=1.0, step_cost=1.0)
    solution = solve_with(GaussSeidel(max_sweeps=600), ObstacleGrid(grid, 8.0), goal, Behavior(LogSumExp(), 5.0))
    assert solution.converged


@pytest.mark.parametrize(("seed", "tolerance", "trusted"), [(0, 1e-5, 6), (1, 1e-10, 12)])
def test_solve_from_a_bad_start_takes_few_more_sweeps(seed, tolerance, trusted):
    """Where walls have opened everywhere, neither earlier values nor their order are of use."""
    random = np.random.default_rng(seed)
    truth = office(60, 60, seed)
    wall = truth.known.reshape(-1) == 1
    logits = np.where(wall, 8.0, -5.0)
    opened = np.where(np.isin(np.arange(truth.size), random.choice(np.flatnonzero(wall), 60)), -1.0, logits)
    closed_model, open_model = (ObstacleGrid(truth.forget(), jnp.asarray(made)) for made in (logits, opened))
    goal = reach(truth.forget(), int(random.choice(np.flatnonzero(~wall))), discount=1.0, step_cost=1.0)
    behavior, solver = Behavior(LogSumExp(), 5.0), GaussSeidel(tolerance=tolerance)
    start = solve_with(solver, closed_model, goal, behavior).start
    cold = solve_with(solver, open_model, goal, behavior)
    warm = solve_with(solver, open_model, goal, behavior, start=start)
    assert warm.sweeps <= cold.sweeps + trusted + 1
    np.testing.assert_allclose(warm.values, cold.values, rtol=10 * tolerance)


def test_solve_from_a_start_nearby_takes_fewer_sweeps():
    truth = office(120, 120, 4)
    wall = truth.known.reshape(-1) == 1
    logits = np.where(wall, 4.0, -4.0)
    model, nearby = (ObstacleGrid(truth.forget(), jnp.asarray(share * logits)) for share in (1.0, 1.02))
    goal = reach(truth.forget(), int(np.flatnonzero(~wall)[0]), discount=1.0, step_cost=1.0)
    behavior, solver = Behavior(LogSumExp(), 5.0), GaussSeidel(tolerance=1e-5)
    start = solve_with(solver, model, goal, behavior).start
    cold, warm = (solve_with(solver, nearby, goal, behavior, start=each) for each in (None, start))
    assert warm.sweeps < cold.sweeps
    np.testing.assert_allclose(warm.values, cold.values, rtol=1e-4)


def test_solve_from_the_solution_at_tolerance_0_keeps_it():
    model = some_map()
    goal = reach(model.graph, 5, discount=0.99)
    first = solve_with(SOLVER, model, goal, agent("Boltzmann"))
    again = solve_with(GaussSeidel(tolerance=0.0, max_sweeps=50), model, goal, agent("Boltzmann"), start=first.start)
    np.testing.assert_allclose(again.values, first.values, rtol=1e-9)


def test_solve_of_a_backup_without_native_code_raises():
    model = some_map(4, 5)
    with pytest.raises(InputError, match="Jacobi"):
        solve_with(GaussSeidel(), model, reach(model.graph, 0), Behavior(Sharper(), 5.0))


def test_default_solver_depends_on_backup_and_size():
    assert isinstance(default_solver(BoltzmannAverage(), 400), GaussSeidel)
    assert isinstance(default_solver(BoltzmannAverage(), 399), Jacobi)
    assert isinstance(default_solver(Sharper(), 400), Jacobi)


def test_cold_start_has_no_values_and_no_order():
    start = GaussSeidel().cold_start(3, jnp.dtype(jnp.float32))
    assert np.isneginf(start.values).all()
    assert start.order.tolist() == [-1, -1, -1]
    assert not start.adjoint.any()
