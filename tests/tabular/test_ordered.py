"""Ordered sweeps: orders, starts, batches, limits, and the machine code beside the formulas that it repeats."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numba
import numpy as np
import pytest
from numba.core import config as numba_settings
from problems import BACKUPS, generic_task, obstacle_problem, random_problem, relative_error

from sidestep.domains.offices import office
from sidestep.errors import InputError
from sidestep.tabular.backups import Behavior, BoltzmannAverage, LogSumExp
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.solve import solve
from sidestep.tabular.solvers.choice import solver_for
from sidestep.tabular.solvers.compiled import compiled
from sidestep.tabular.solvers.given import Given, positions, sizes
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.solvers.numbering import numbered, numbering_for
from sidestep.tabular.solvers.order import _ascending, order_by_distance
from sidestep.tabular.solvers.ordered import KERNELS, Ordered
from sidestep.tabular.solvers.passing import weigh
from sidestep.tabular.solvers.process import lowest
from sidestep.tabular.solvers.rounds import Rounds
from sidestep.tabular.solvers.sweeping import Scratch, Valuing, backed_up
from sidestep.tasks import reach, stack_tasks

each_backup = pytest.mark.parametrize("name", BACKUPS)
SOLVER = Ordered(tolerance=1e-11)


@eqx.filter_jit
def values_and_slopes(model, wanted, people, start=None, solver=SOLVER):
    """A solution, and the gradients of a sum over its values by the parameters and by the adjoint to start from."""
    if start is None:
        start = solver.cold_start(model.graph.states, model.probabilities().dtype)

    def total(parameters, adjoint):
        begin = start._replace(adjoint=adjoint)
        found = solve(model.with_parameters(parameters), wanted, people, solver=solver, start=begin)
        weights = jnp.cos(jnp.arange(found.values.size)).astype(found.values.dtype)
        return jnp.sum(weights * found.values), found

    slopes, found = jax.grad(total, (0, 1), has_aux=True)(model.parameters, start.adjoint)
    return found, *slopes


def people(name, beta=5.0):
    return Behavior(BACKUPS[name], beta)


def some_map(rows=20, columns=21, seed=0):
    """A map of mostly free cells; 420 states."""
    grid = Grid.unknown(rows, columns)
    return ObstacleGrid(grid, jnp.asarray(np.random.default_rng(seed).normal(-1.5, 1.5, grid.size)))


# Orders


def order_of(model, wanted):
    successors, probabilities = np.asarray(model.graph.successors), np.asarray(model.probabilities())
    reward, terminal = np.asarray(wanted.reward), np.asarray(wanted.terminal)
    return order_by_distance(successors, probabilities, reward, terminal, float(wanted.discount))


def test_order_of_a_corridor_with_a_slow_cell():
    """To enter cell 2 takes 10 tries, so from cells 0 to 6 it takes 12, 11, 1, 0, 1, 2 and 3 to get to cell 3."""
    blocked = np.array([1e-9, 1e-9, 0.9, 1e-9, 1e-9, 1e-9, 1e-9])
    model = ObstacleGrid(Grid.unknown(1, 7), jnp.asarray(np.log(blocked) - np.log1p(-blocked)))
    order = order_of(model, reach(Grid.unknown(1, 7), 3, discount=1.0, step_cost=1.0)).tolist()
    assert order[0] == 3
    assert sorted(order[1:3]) == [2, 4]  # both at distance 1
    assert order[3:] == [5, 6, 1, 0]


def test_discount_makes_slow_cells_far():
    """A goal that pays, and no step cost: what counts is how much the tries discount."""
    model = ObstacleGrid(Grid.unknown(1, 5), jnp.asarray([0.0, 5.0, 0.0, -5.0, -5.0]))
    order = order_of(model, reach(Grid.unknown(1, 5), 2, discount=0.9)).tolist()
    assert order[0] == 2
    assert order.index(4) < order.index(0)


def test_states_out_of_reach_come_last():
    """Nobody enters the wall in the middle, but who starts inside it gets out."""
    world = Grid(np.array([[-1, -1, 1, -1, -1]]))
    model = ObstacleGrid(world, 0.0)
    assert order_of(model, reach(world, 4, discount=1.0, step_cost=1.0)).tolist() == [4, 3, 2, 0, 1]


def test_states_ascend_and_ties_keep_their_numbers():
    random = np.random.default_rng(0)
    distances = np.exp(random.uniform(-700, 700, 5_000))
    distances[::7], distances[5::17], distances[3::13] = 0, distances[4], np.inf
    near = distances[11] * (1 + np.arange(200) * 2.0**-50)
    distances[1::25] = random.permutation(near)
    np.testing.assert_array_equal(_ascending(distances), np.argsort(distances, kind="stable"))


def test_the_reach_is_how_far_apart_a_state_and_its_successors_stand():
    model = some_map()
    order = np.random.default_rng(0).permutation(420).astype(np.int32)
    position = positions(order)
    assert position is not None
    successors = np.asarray(model.graph.successors)
    terminal, probabilities = np.arange(420) == 5, np.asarray(model.probabilities())
    given = Given(successors, probabilities, np.zeros((1, 1)), np.ones(1), terminal, np.float64(0.99))
    found = numbered(numbering_for(*sizes(given)), given, order, position).reach
    assert found == np.abs(position[successors] - position[:, None, None]).max()


@pytest.mark.parametrize("solver", [SOLVER, Jacobi(tolerance=1e-11)], ids=["Ordered", "Jacobi"])
def test_states_are_counted_from_either_end_and_there_are_no_others(solver):
    model, wanted = some_map(), reach(Grid.unknown(20, 21), 5, discount=0.99)
    visited = jnp.asarray([3, -1, -420, 419, 1_000])
    found = solve(model, wanted, people("Boltzmann"), solver=solver, visited=visited)
    every = solve(model, wanted, people("Boltzmann"), solver=solver)
    np.testing.assert_array_equal(found.action_values, every.action_values[jnp.asarray([3, 419, 0, 419, 419])])


def test_no_end_no_order():
    problem = random_problem()
    wanted = eqx.tree_at(lambda task: task.terminal, generic_task(problem, 0.9), jnp.zeros(7, dtype=bool))
    assert order_of(problem.model, wanted).tolist() == list(range(7))


# Machine code


@numba.njit
def back_up_all(valuing, q, leaving):
    values, divisors = np.empty(len(q), q.dtype), np.empty(len(q), q.dtype)
    for i in range(len(q)):
        values[i], divisors[i] = backed_up(valuing, Scratch(q[i], leaving[i], q[i]))
    return values, divisors


@numba.njit
def weigh_all(valuing, exact, q):
    weights, policy, by_beta = np.empty_like(q), np.empty_like(q), np.empty(len(q), q.dtype)
    for i in range(len(q)):
        by_beta[i] = weigh(valuing, exact, q[i], weights[i], policy[i])
    return weights, policy, by_beta


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@each_backup
def test_machine_code_repeats_the_backups(name, dtype):
    """Value, weights, policy and derivative by β; random, tied, and widely spread action values."""
    rng = np.random.default_rng(0)
    q = np.concatenate([rng.normal(size=(20, 4)), rng.normal(-500, 0.1, (20, 4)), rng.choice([-1.0, -2.0], (20, 4))])
    q = np.concatenate([q, np.where(rng.random((20, 4)) < 0.5, -1e6, rng.normal(size=(20, 4)))]).astype(dtype)
    leaving = rng.uniform(0.01, 1, q.shape).astype(dtype)
    backup, beta = BACKUPS[name], dtype(3.0)
    tie = max(getattr(backup, "tie", 0.0), 64 * float(np.finfo(dtype).eps))
    valuing = Valuing(KERNELS[type(backup)], beta, dtype(tie))
    within = 1e-12 if dtype == np.float64 else 3e-4
    close = partial(np.testing.assert_allclose, rtol=within, atol=within)

    arguments = jnp.asarray(q), jnp.asarray(beta)
    value, by_beta = (np.asarray(each) for each in value_and_derivative(backup, *arguments))
    exact, policy = np.asarray(backup.weights(*arguments)), np.asarray(backup.fixed_policy_weights(*arguments))
    values, divisors = back_up_all(valuing, q, leaving)
    close(values, value)
    close(divisors, np.maximum((exact * leaving).sum(axis=1), (policy * leaving).sum(axis=1)))
    for which, weights, derivative in ((True, exact, by_beta), (False, policy, 0 * by_beta)):
        found = weigh_all(valuing, which, q)
        for mine, theirs in zip(found, (weights, policy, derivative), strict=True):
            close(mine, theirs)
            assert mine.dtype == dtype
    assert values.dtype == divisors.dtype == dtype


def test_an_action_that_is_worth_all_but_minus_infinity():
    """It is never taken, and has no part in the derivative by β."""
    q = np.array([[-1.0, lowest(jnp.dtype(jnp.float64)), -2.0]])
    for name in ("Boltzmann", "mellowmax"):
        found = weigh_all(Valuing(KERNELS[type(BACKUPS[name])], np.float64(3), np.float64(0)), True, q)
        assert np.isfinite(np.concatenate([each.ravel() for each in found])).all()
        assert found[0][0, 1] == found[1][0, 1] == 0


def value_and_derivative(backup, q, beta):
    values = partial(backup.value, q)
    return values(beta), jax.jacfwd(values)(beta)


def test_machine_code_where_nothing_can_be_written(monkeypatch):
    """numba finds no folder to keep its code in; the code is compiled all the same."""
    monkeypatch.setattr(numba_settings, "CACHE_LOCATOR_CLASSES", "ZipCacheLocator")
    with pytest.raises(RuntimeError, match="locator"):
        numba.njit(cache=True)(lambda x: x + 1)
    assert compiled()(lambda x: x + 1)(1) == 2


# Starts


@each_backup
def test_any_start_gives_the_same(name):
    """From a model nearby, from a wrong order, from values of no meaning, from what failed: as from nothing."""
    model, rng = some_map(), np.random.default_rng(1)
    wanted = reach(model.graph, 5, discount=1.0, step_cost=1.0)
    cold, slope, adjoint = values_and_slopes(model, wanted, people(name))
    moved = model.with_parameters(model.parameters + 0.1 * rng.normal(size=model.parameters.shape))
    near, _, near_adjoint = values_and_slopes(moved, wanted, people(name))
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
        found, its_slope, its_adjoint = values_and_slopes(model, wanted, people(name), start)
        assert found.converged, label
        assert relative_error(found.values, cold.values) < 1e-8, label
        assert relative_error(its_slope, slope) < 1e-7, label
        assert relative_error(its_adjoint, adjoint) < 1e-7, label
        assert sorted(found.start.order.tolist()) == list(range(420)), label
    again, _, _ = values_and_slopes(model, wanted, people(name), starts["the solution"])
    assert again.sweeps <= 2


@each_backup
@pytest.mark.parametrize("warm", [False, True])
def test_the_adjoint_solves_its_equation(name, warm):
    """λ = g + Wᵀλ, with W dense and its weights by differentiating the backup."""
    problem = obstacle_problem(4)
    wanted = generic_task(problem, 0.95)
    start = None
    if warm:
        start = SOLVER.cold_start(12, jnp.dtype(jnp.float64))._replace(adjoint=jnp.linspace(-1.0, 1.0, 12))
    found, _, adjoint = values_and_slopes(problem.model, wanted, people(name), start)
    weights = np.asarray(jax.vmap(jax.grad(BACKUPS[name].value), (0, None))(found.action_values, jnp.asarray(5.0)))
    transitions = np.asarray(problem.dense(problem.model.parameters))
    matrix = 0.95 * np.einsum("sa,sat->st", weights, transitions) * ~np.asarray(wanted.terminal)[:, None]
    expected = np.linalg.solve(np.eye(12) - matrix.T, np.cos(np.arange(12)))
    np.testing.assert_allclose(adjoint, expected, rtol=1e-8, atol=1e-8)


def test_a_start_that_another_solver_left():
    """Jacobi leaves no order."""
    model = some_map(4, 5)
    wanted, behavior = reach(model.graph, 5), people("Boltzmann")
    start = solve(model, wanted, behavior, solver=Jacobi()).start
    found = solve(model, wanted, behavior, solver=SOLVER, start=start)
    assert found.converged
    assert found.start.order.tolist()[0] == 5


# Batches


def test_nested_batches_and_loops():
    """Over β and over tasks at once, in a scan, in a map: each as by itself."""
    model = some_map(4, 5)
    tasks = stack_tasks([reach(model.graph, goal, discount=0.9) for goal in (0, 7, 19)])
    betas = jnp.asarray([1.0, 10.0])

    def of(parameters, beta, wanted):
        def total(parameters, beta):
            behavior = Behavior(BoltzmannAverage(), beta)
            return jnp.sum(jnp.sin(solve(model.with_parameters(parameters), wanted, behavior, solver=SOLVER).values))

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
    given = (problem.model, generic_task(problem, 0.9), people(name))
    exact, exact_slope, _ = values_and_slopes(*given)
    narrow = jax.tree.map(lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x, given)
    found, slope, adjoint = values_and_slopes(*narrow, solver=Ordered())
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
    solver = Ordered(max_sweeps=most, tolerance=1e-14)
    found, slope, _ = values_and_slopes(model, wanted, people(name, 0.5), solver=solver)
    assert not found.converged
    assert jnp.isnan(slope).all()


@pytest.mark.parametrize("name", ["hard max", "Boltzmann"])
@pytest.mark.parametrize("where", ["parameters", "reward", "beta"])
def test_what_is_no_number_is_never_a_solution(name, where):
    model = some_map(4, 5)
    wanted, behavior = reach(model.graph, 5), people(name)
    if where == "parameters":
        model = model.with_parameters(model.parameters.at[3].set(jnp.nan))
    elif where == "reward":
        wanted = eqx.tree_at(lambda task: task.reward, wanted, jnp.full((1, 1), jnp.nan))
    else:
        behavior = eqx.tree_at(lambda people: people.beta, behavior, jnp.asarray(jnp.nan))
    found, slope, _ = values_and_slopes(model, wanted, behavior)
    assert not found.converged
    assert jnp.isnan(slope).all()


def test_the_last_sweep_leaves_nobody_out():
    """States that seem to have nothing to do, because nobody said that values changed, are still looked at."""
    rounds, solved = settled_rounds()
    rounds.values[1:] *= 0.5
    rounds.marks.changed[:], rounds.marks.solved[:] = 0, rounds.number
    assert rounds.until_still().converged
    np.testing.assert_allclose(rounds.values, solved, rtol=1e-8)


def settled_rounds():
    """Rounds that have come to rest, and the values that they were at."""
    model = some_map()
    found = solve(model, reach(model.graph, 5, discount=0.99), people("Boltzmann", 1.0), solver=SOLVER)
    order = np.asarray(found.start.order)
    position = positions(order)
    assert position is not None
    terminal, one = np.arange(420) == 5, np.float64(1)
    successors, probabilities = np.asarray(model.graph.successors), np.asarray(model.probabilities())
    given = Given(successors, probabilities, np.zeros((1, 1)), np.ones(1), terminal, np.float64(0.99))
    world = numbered(numbering_for(*sizes(given)), given, order, position)
    values = np.asarray(found.values)[order]
    solved = values.copy()
    valuing = Valuing(KERNELS[BoltzmannAverage], one, 0 * one)
    everyone = np.arange(420, dtype=np.int32)
    rounds = Rounds(world, values, everyone.copy(), everyone, valuing, np.float64(1e-11), 1000, 1000)
    assert rounds.until_still().converged
    return rounds, solved


def test_after_the_last_sweep_all_that_saw_a_change_have_something_to_do():
    """None of them saw what the others became, wherever they stand in the order."""
    rounds, _ = settled_rounds()
    rounds.values[1:] *= 0.5
    rounds._once_more()
    world, marks = rounds.world, rounds.marks
    moved = marks.changed == rounds.number
    near = moved | moved[world.successors].any(axis=(1, 2))
    assert near.sum() > 0
    before = rounds.values.copy()
    rounds._sweep(np.flatnonzero(near).astype(np.int32), shifted=len(before))
    assert (marks.solved[near & ~world.fixed] == rounds.number).all()
    assert (rounds.values != before)[near & ~world.fixed].mean() > 0.9


class Sharper(BoltzmannAverage):
    """A backup that nobody has written machine code for, though its parent has it."""


def test_values_that_move_each_other_come_to_rest():
    """In this world of cells that are all but closed, shifts in every round would send two states round in a cycle."""
    random = np.random.default_rng(78)
    walls, closed = random.random((60, 60)) < 0.3, random.random((60, 60)) < 0.1
    grid = Grid(np.where(closed, -1, walls.astype(int)))
    goal = reach(grid, int(np.flatnonzero(grid.known == 0)[0]), discount=1.0, step_cost=1.0)
    found = solve(ObstacleGrid(grid, 8.0), goal, Behavior(LogSumExp(), 5.0), solver=Ordered(max_sweeps=600))
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
    walkers, solver = Behavior(LogSumExp(), 5.0), Ordered(tolerance=tolerance)
    start = solve(closed_model, goal, walkers, solver=solver).start
    cold = solve(open_model, goal, walkers, solver=solver)
    warm = solve(open_model, goal, walkers, solver=solver, start=start)
    assert warm.sweeps <= cold.sweeps + trusted + 1
    np.testing.assert_allclose(warm.values, cold.values, rtol=10 * tolerance)


def test_a_start_nearby_is_not_given_up_though_it_takes_many_rounds():
    truth = office(120, 120, 4)
    wall = truth.known.reshape(-1) == 1
    logits = np.where(wall, 4.0, -4.0)
    model, nearby = (ObstacleGrid(truth.forget(), jnp.asarray(share * logits)) for share in (1.0, 1.02))
    goal = reach(truth.forget(), int(np.flatnonzero(~wall)[0]), discount=1.0, step_cost=1.0)
    walkers, solver = Behavior(LogSumExp(), 5.0), Ordered(tolerance=1e-5)
    start = solve(model, goal, walkers, solver=solver).start
    cold, warm = (solve(nearby, goal, walkers, solver=solver, start=each) for each in (None, start))
    assert warm.sweeps < cold.sweeps
    np.testing.assert_allclose(warm.values, cold.values, rtol=1e-4)


def test_a_start_is_trusted_for_a_while_even_if_no_tolerance_is_left():
    model = some_map()
    goal = reach(model.graph, 5, discount=0.99)
    first = solve(model, goal, people("Boltzmann"), solver=SOLVER)
    again = solve(model, goal, people("Boltzmann"), solver=Ordered(tolerance=0.0, max_sweeps=50), start=first.start)
    np.testing.assert_allclose(again.values, first.values, rtol=1e-9)


def test_backups_without_machine_code_are_refused():
    model = some_map(4, 5)
    with pytest.raises(InputError, match="Jacobi"):
        solve(model, reach(model.graph, 0), Behavior(Sharper(), 5.0), solver=Ordered())


def test_the_choice_of_a_solver():
    assert isinstance(solver_for(BoltzmannAverage(), 400), Ordered)
    assert isinstance(solver_for(BoltzmannAverage(), 399), Jacobi)
    assert isinstance(solver_for(Sharper(), 400), Jacobi)


def test_cold_starts_know_nothing():
    start = Ordered().cold_start(3, jnp.dtype(jnp.float32))
    assert (start.values == lowest(jnp.dtype(jnp.float32))).all()
    assert start.order.tolist() == [-1, -1, -1]
    assert not start.adjoint.any()
