"""Solves by ordered sweeps: starts, batches, limits. What the sweeps are made of is in `test_sweeps`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.numbered_worlds import some_map
from helpers.problems import BACKUPS, generic_task, obstacle_problem, random_problem, relative_error
from sidestep.errors import InputError
from sidestep.tabular.backups import Behavior, BoltzmannAverage, LogSumExp
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.solve import SolveOptions, default_solver, solve
from sidestep.tabular.solvers.base import neg_inf
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
        found = solve(
            model.with_parameters(parameters), wanted, agent, options=SolveOptions(solver=solver), start=begin
        )
        weights = jnp.cos(jnp.arange(found.values.size)).astype(found.values.dtype)
        return jnp.sum(weights * found.values), found

    slopes, found = jax.grad(total, (0, 1), has_aux=True)(model.parameters, start.adjoint)
    return found, *slopes


def agent(name, beta=5.0):
    return Behavior(BACKUPS[name], beta)


# Starts


@each_backup
def test_any_start_gives_the_same(name):
    """From a model nearby, from a wrong order, from values of no meaning, from what failed: as from nothing."""
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
        found, its_slope, its_adjoint = values_and_slopes(model, wanted, agent(name), start)
        assert found.converged, label
        assert relative_error(found.values, cold.values) < 1e-8, label
        assert relative_error(its_slope, slope) < 1e-7, label
        assert relative_error(its_adjoint, adjoint) < 1e-7, label
        assert sorted(found.start.order.tolist()) == list(range(420)), label
    again, _, _ = values_and_slopes(model, wanted, agent(name), starts["the solution"])
    assert again.sweeps <= 2


@each_backup
@pytest.mark.parametrize("first", ["none", "all", "few"])
def test_the_adjoint_solves_its_equation(name, first):
    """λ = g + Wᵀλ, with W dense and its weights by differentiating the backup; whatever λ it starts from."""
    problem = obstacle_problem(4)
    wanted = generic_task(problem, 0.95)
    everywhere = jnp.linspace(-1.0, 1.0, 12)
    adjoints = {"none": jnp.zeros(12), "all": everywhere, "few": jnp.zeros(12).at[jnp.asarray([3, 8])].set(2.0)}
    start = SOLVER.cold_start(12, jnp.dtype(jnp.float64))._replace(adjoint=adjoints[first])
    found, _, adjoint = values_and_slopes(problem.model, wanted, agent(name), start)
    weights = np.asarray(jax.vmap(jax.grad(BACKUPS[name].value), (0, None))(found.action_values, jnp.asarray(5.0)))
    transitions = np.asarray(problem.dense(problem.model.parameters))
    matrix = 0.95 * np.einsum("sa,sat->st", weights, transitions) * ~np.asarray(wanted.terminal)[:, None]
    expected = np.linalg.solve(np.eye(12) - matrix.T, np.cos(np.arange(12)))
    np.testing.assert_allclose(adjoint, expected, rtol=1e-8, atol=1e-8)


def test_a_start_that_another_solver_left():
    """Jacobi leaves no order."""
    model = some_map(4, 5)
    wanted, behavior = reach(model.graph, 5), agent("Boltzmann")
    start = solve(model, wanted, behavior, options=SolveOptions(solver=Jacobi())).start
    found = solve(model, wanted, behavior, options=SolveOptions(solver=SOLVER), start=start)
    assert found.converged
    assert found.start.order.tolist()[0] == 5


def test_traces_of_an_earlier_adjoint_are_forgotten():
    """Else states that do not matter any more would count as ones that do."""
    model = some_map()
    wanted, behavior = reach(model.graph, 5, discount=0.9, step_cost=1.0), agent("hard max")
    start = SOLVER.cold_start(420, jnp.dtype(jnp.float64))

    def of_one_state(adjoint):
        return solve(
            model, wanted, behavior, options=SolveOptions(solver=SOLVER), start=start._replace(adjoint=adjoint)
        ).values[8]

    cold, traces = (jax.grad(of_one_state)(jnp.full(420, size)) for size in (0.0, 1e-30))
    assert 0 < jnp.count_nonzero(cold) < 420
    np.testing.assert_array_equal(traces, cold)


# Which states


@pytest.mark.parametrize("solver", [SOLVER, Jacobi(tolerance=1e-11)], ids=["GaussSeidel", "Jacobi"])
def test_states_are_counted_from_either_end_and_there_are_no_others(solver):
    model, wanted = some_map(), reach(Grid.unknown(20, 21), 5, discount=0.99)
    visited = jnp.asarray([3, -1, -420, 419, 1_000])
    found = solve(model, wanted, agent("Boltzmann"), options=SolveOptions(solver=solver), visited=visited)
    every = solve(model, wanted, agent("Boltzmann"), options=SolveOptions(solver=solver))
    np.testing.assert_array_equal(found.action_values, every.action_values[jnp.asarray([3, 419, 0, 419, 419])])


# Batches


def test_nested_batches_and_loops():
    """Over β and over tasks at once, in a scan, in a map: each as by itself."""
    model = some_map(4, 5)
    tasks = stack_tasks([reach(model.graph, goal, discount=0.9) for goal in (0, 7, 19)])
    betas = jnp.asarray([1.0, 10.0])

    def of(parameters, beta, wanted):
        def total(parameters, beta):
            behavior = Behavior(BoltzmannAverage(), beta)
            return jnp.sum(
                jnp.sin(
                    solve(
                        model.with_parameters(parameters), wanted, behavior, options=SolveOptions(solver=SOLVER)
                    ).values
                )
            )

        return jax.value_and_grad(total, (0, 1))(parameters, beta)

    one = jax.jit(of)
    single = [one(model.parameters, beta, jax.tree.map(lambda x, i=i: x[i], tasks)) for beta in betas for i in range(3)]
    leaves = zip(*(jax.tree.leaves(each) for each in single), strict=True)
    expected = [jnp.stack(each).reshape(2, 3, *each[0].shape) for each in leaves]
    over_tasks = jax.vmap(of, (None, None, 0))
    ways = {
        "nested": jax.vmap(over_tasks, (None, 0, None)),
        "map": lambda parameters, betas, tasks: jax.lax.map(lambda beta: over_tasks(parameters, beta, tasks), betas),
        "scan": lambda parameters, betas, tasks: jax.lax.scan(
            lambda carried, beta: (carried, over_tasks(carried, beta, tasks)), parameters, betas
        )[1],
    }
    for way, function in ways.items():
        found = jax.tree.leaves(jax.jit(function)(model.parameters, betas, tasks))
        for mine, theirs in zip(found, expected, strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-12, atol=1e-12, err_msg=way)


@pytest.mark.parametrize("name", ["hard max", "Boltzmann"])
def test_32_bit_numbers_stay(name):
    problem = random_problem()
    given = (problem.model, generic_task(problem, 0.9), agent(name))
    exact, exact_slope, _ = values_and_slopes(*given)
    narrow = jax.tree.map(lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x, given)
    found, slope, adjoint = values_and_slopes(*narrow, solver=GaussSeidel())
    arrays = (found.values, found.action_values, found.residual, found.start.values, slope, adjoint)
    assert {array.dtype for array in arrays} == {jnp.dtype(jnp.float32)}
    assert found.converged
    assert relative_error(found.values, exact.values) < 1e-4
    assert relative_error(slope, exact_slope) < 1e-3


# Limits


@pytest.mark.parametrize(("name", "most"), [("hard max", 0), ("hard max", 1), ("Boltzmann", 1), ("Boltzmann", 3)])
def test_a_solve_that_was_stopped_says_so(name, most):
    model = some_map()
    wanted = reach(model.graph, 5, discount=0.999)
    solver = GaussSeidel(max_sweeps=most, tolerance=1e-14)
    found, slope, _ = values_and_slopes(model, wanted, agent(name, 0.5), solver=solver)
    assert not found.converged
    assert jnp.isnan(slope).all()


@pytest.mark.parametrize("name", ["hard max", "Boltzmann"])
@pytest.mark.parametrize("where", ["parameters", "reward", "beta"])
def test_what_is_no_number_is_never_a_solution(name, where):
    model = some_map(4, 5)
    wanted, behavior = reach(model.graph, 5), agent(name)
    if where == "parameters":
        model = model.with_parameters(model.parameters.at[3].set(jnp.nan))
    elif where == "reward":
        wanted = eqx.tree_at(lambda task: task.reward, wanted, jnp.full((1, 1), jnp.nan))
    else:
        behavior = eqx.tree_at(lambda agent: agent.beta, behavior, jnp.asarray(jnp.nan))
    found, slope, _ = values_and_slopes(model, wanted, behavior)
    assert not found.converged
    assert jnp.isnan(slope).all()


class Sharper(BoltzmannAverage):
    """A backup that nobody has written machine code for, though its parent has it."""


def test_values_that_move_each_other_come_to_rest():
    """In this world of cells that are all but closed, shifts in every round would send two states round in a cycle."""
    random = np.random.default_rng(78)
    walls, closed = random.random((60, 60)) < 0.3, random.random((60, 60)) < 0.1
    grid = Grid(np.where(closed, -1, walls.astype(int)))
    goal = reach(grid, int(np.flatnonzero(grid.known == 0)[0]), discount=1.0, step_cost=1.0)
    found = solve(
        ObstacleGrid(grid, 8.0),
        goal,
        Behavior(LogSumExp(), 5.0),
        options=SolveOptions(solver=GaussSeidel(max_sweeps=600)),
    )
    assert found.converged


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("tolerance", "trusted"), [(1e-5, 6), (1e-10, 12)])
def test_a_start_that_leads_astray_costs_no_more_than_it_was_trusted(seed, tolerance, trusted):
    """Where walls have opened everywhere neither old values nor their order serve, and all is as from no start."""
    random = np.random.default_rng(seed)
    truth = office(60, 60, seed)
    wall = truth.known.reshape(-1) == 1
    logits = np.where(wall, 8.0, -5.0)
    opened = np.where(np.isin(np.arange(truth.size), random.choice(np.flatnonzero(wall), 60)), -1.0, logits)
    closed_model, open_model = (ObstacleGrid(truth.forget(), jnp.asarray(made)) for made in (logits, opened))
    goal = reach(truth.forget(), int(random.choice(np.flatnonzero(~wall))), discount=1.0, step_cost=1.0)
    walkers, solver = Behavior(LogSumExp(), 5.0), GaussSeidel(tolerance=tolerance)
    start = solve(closed_model, goal, walkers, options=SolveOptions(solver=solver)).start
    cold = solve(open_model, goal, walkers, options=SolveOptions(solver=solver))
    warm = solve(open_model, goal, walkers, options=SolveOptions(solver=solver), start=start)
    assert warm.sweeps <= cold.sweeps + trusted + 1
    np.testing.assert_allclose(warm.values, cold.values, rtol=10 * tolerance)


def test_a_start_nearby_is_not_given_up_though_it_takes_many_rounds():
    truth = office(120, 120, 4)
    wall = truth.known.reshape(-1) == 1
    logits = np.where(wall, 4.0, -4.0)
    model, nearby = (ObstacleGrid(truth.forget(), jnp.asarray(share * logits)) for share in (1.0, 1.02))
    goal = reach(truth.forget(), int(np.flatnonzero(~wall)[0]), discount=1.0, step_cost=1.0)
    walkers, solver = Behavior(LogSumExp(), 5.0), GaussSeidel(tolerance=1e-5)
    start = solve(model, goal, walkers, options=SolveOptions(solver=solver)).start
    cold, warm = (
        solve(nearby, goal, walkers, options=SolveOptions(solver=solver), start=each) for each in (None, start)
    )
    assert warm.sweeps < cold.sweeps
    np.testing.assert_allclose(warm.values, cold.values, rtol=1e-4)


def test_a_start_is_trusted_for_a_while_even_if_no_tolerance_is_left():
    model = some_map()
    goal = reach(model.graph, 5, discount=0.99)
    first = solve(model, goal, agent("Boltzmann"), options=SolveOptions(solver=SOLVER))
    again = solve(
        model,
        goal,
        agent("Boltzmann"),
        options=SolveOptions(solver=GaussSeidel(tolerance=0.0, max_sweeps=50)),
        start=first.start,
    )
    np.testing.assert_allclose(again.values, first.values, rtol=1e-9)


def test_backups_without_machine_code_are_refused():
    model = some_map(4, 5)
    with pytest.raises(InputError, match="Jacobi"):
        solve(model, reach(model.graph, 0), Behavior(Sharper(), 5.0), options=SolveOptions(solver=GaussSeidel()))


def test_the_choice_of_a_solver():
    assert isinstance(default_solver(BoltzmannAverage(), 400), GaussSeidel)
    assert isinstance(default_solver(BoltzmannAverage(), 399), Jacobi)
    assert isinstance(default_solver(Sharper(), 400), Jacobi)


def test_cold_starts_know_nothing():
    start = GaussSeidel().cold_start(3, jnp.dtype(jnp.float32))
    assert (start.values == neg_inf(jnp.dtype(jnp.float32))).all()
    assert start.order.tolist() == [-1, -1, -1]
    assert not start.adjoint.any()
