"""The parts of Gauss–Seidel sweeps: orders, native code beside the formulas that it repeats, its cache, the loop."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.numbered_worlds import NO_COSTS, numbered_process, order_of, some_map
from helpers.problems import BACKUPS, generic_task, random_problem
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.solve import SolveOptions, solve
from sidestep.tabular.solvers.adjoint_kernels import WeightScratch, differentiate_backup
from sidestep.tabular.solvers.gauss_seidel import KERNELS, GaussSeidel
from sidestep.tabular.solvers.native import NativeBackup, compiled
from sidestep.tabular.solvers.sweep_loop import SweepLoop
from sidestep.tabular.solvers.value_kernels import Scratch, backed_up
from sidestep.tabular.tasks import reach

each_backup = pytest.mark.parametrize("name", BACKUPS)


# Orders


def test_order_by_distance_corridor_with_a_slow_cell_counts_expected_steps():
    """To enter cell 2 takes 10 attempts, so from cells 0 to 6 it takes 12, 11, 1, 0, 1, 2 and 3 to reach cell 3."""
    blocked = np.array([1e-9, 1e-9, 0.9, 1e-9, 1e-9, 1e-9, 1e-9])
    model = ObstacleGrid(Grid.unknown(1, 7), jnp.asarray(np.log(blocked) - np.log1p(-blocked)))
    order = order_of(model, reach(Grid.unknown(1, 7), 3, discount=1.0, step_cost=1.0)).tolist()
    assert order[0] == 3
    assert sorted(order[1:3]) == [2, 4]  # both at distance 1
    assert order[3:] == [5, 6, 1, 0]


def test_order_by_distance_goal_that_pays_counts_the_discount():
    """Without a step cost, what counts is how much repeated moves discount."""
    model = ObstacleGrid(Grid.unknown(1, 5), jnp.asarray([0.0, 5.0, 0.0, -5.0, -5.0]))
    order = order_of(model, reach(Grid.unknown(1, 5), 2, discount=0.9)).tolist()
    assert order[0] == 2
    assert order.index(4) < order.index(0)


def test_order_by_distance_puts_unreachable_states_last():
    """The wall in the middle cannot be entered, but left."""
    world = Grid(np.array([[-1, -1, 1, -1, -1]]))
    model = ObstacleGrid(world, 0.0)
    assert order_of(model, reach(world, 4, discount=1.0, step_cost=1.0)).tolist() == [4, 3, 2, 0, 1]


def test_order_by_distance_without_terminal_states_keeps_the_numbers():
    problem = random_problem()
    task = eqx.tree_at(lambda task: task.terminal, generic_task(problem, 0.9), jnp.zeros(7, dtype=bool))
    assert order_of(problem.model, task).tolist() == list(range(7))


def test_number_process_bandwidth_is_the_largest_difference_of_positions():
    model = some_map()
    order = np.random.default_rng(0).permutation(420).astype(np.int32)
    position, successors = np.argsort(order), np.asarray(model.graph.successors)
    bandwidth = numbered_process(model, reach(model.graph, 5, discount=0.99), order).bandwidth
    assert bandwidth == np.abs(position[successors] - position[:, None, None]).max()


# Native code


@compiled()
def back_up_all(backup, q, exit_weights):
    values, divisors = np.empty(len(q), q.dtype), np.empty(len(q), q.dtype)
    for i in range(len(q)):
        values[i], divisors[i] = backed_up(backup, q.shape[1], Scratch(q[i], exit_weights[i], q[i]))
    return values, divisors


@compiled()
def differentiate_all(backup, exact, q):
    weights, policy, by_beta = np.empty_like(q), np.empty_like(q), np.empty(len(q), q.dtype)
    for i in range(len(q)):
        by_beta[i] = differentiate_backup(backup, exact, q.shape[1], WeightScratch(q[i], weights[i], policy[i]))
    return weights, policy, by_beta


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@each_backup
def test_backup_kernels_equal_the_backups(name, dtype):
    """Value, weights, policy and derivative by β; random, tied, and widely spread action values."""
    rng = np.random.default_rng(0)
    q = np.concatenate([rng.normal(size=(20, 4)), rng.normal(-500, 0.1, (20, 4)), rng.choice([-1.0, -2.0], (20, 4))])
    q = np.concatenate([q, np.where(rng.random((20, 4)) < 0.5, -1e6, rng.normal(size=(20, 4)))]).astype(dtype)
    exit_weights = rng.uniform(0.01, 1, q.shape).astype(dtype)
    backup, beta = BACKUPS[name], dtype(3.0)
    tie = max(getattr(backup, "tie", 0.0), 64 * float(np.finfo(dtype).eps))
    native = NativeBackup(KERNELS[type(backup)], beta, dtype(tie))
    within = 1e-12 if dtype == np.float64 else 3e-4
    close = partial(np.testing.assert_allclose, rtol=within, atol=within)

    arguments = jnp.asarray(q), jnp.asarray(beta)
    value_of = partial(backup.value, arguments[0])
    value, by_beta = np.asarray(value_of(arguments[1])), np.asarray(jax.jacfwd(value_of)(arguments[1]))
    exact, policy = np.asarray(backup.weights(*arguments)), np.asarray(backup.fixed_policy_weights(*arguments))
    values, divisors = back_up_all(native, q, exit_weights)
    close(values, value)
    close(divisors, np.maximum((exact * exit_weights).sum(axis=1), (policy * exit_weights).sum(axis=1)))
    for is_exact, weights, derivative in ((True, exact, by_beta), (False, policy, 0 * by_beta)):
        for ours, expected in zip(differentiate_all(native, is_exact, q), (weights, policy, derivative), strict=True):
            close(ours, expected)
            assert ours.dtype == dtype
    assert values.dtype == divisors.dtype == dtype


@pytest.mark.parametrize("name", ["Boltzmann", "mellowmax"])
def test_differentiate_backup_of_an_action_worth_minus_infinity_is_finite(name):
    """It is never taken, and has no part in the derivative by β."""
    q = np.array([[-1.0, -np.inf, -2.0]])
    native = NativeBackup(KERNELS[type(BACKUPS[name])], np.float64(3), np.float64(0))
    weights, policy, by_beta = differentiate_all(native, True, q)
    assert np.isfinite(np.concatenate([weights.ravel(), policy.ravel(), by_beta])).all()
    assert weights[0, 1] == policy[0, 1] == 0


# The cache of native code


def plus_one_hits():
    """A native function as a new process makes it, and how often its code was read from the cache."""
    function = compiled()(lambda x: x + 1)
    assert function(1) == 2
    return sum(function.dispatcher().stats.cache_hits.values())


def test_compiled_keeps_code_and_rebuilds_a_damaged_entry(tmp_path, monkeypatch):
    monkeypatch.setenv("SIDESTEP_CACHE", str(tmp_path))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    assert [plus_one_hits(), plus_one_hits()] == [0, 1]
    (entry,) = tmp_path.rglob("*.code")
    entry.write_bytes(entry.read_bytes()[:-1])
    assert [plus_one_hits(), plus_one_hits()] == [0, 1]


@pytest.mark.parametrize("folder", ["off", "/dev/null/cache"], ids=["off", "not writable"])
def test_compiled_without_a_folder_compiles_anew(folder, monkeypatch):
    monkeypatch.setenv("SIDESTEP_CACHE", folder)
    assert [plus_one_hits(), plus_one_hits()] == [0, 0]


# The loop of sweeps


def converged_loop():
    """A loop that has converged, and its values."""
    model, one = some_map(), np.float64(1)
    task, solver = reach(model.graph, 5, discount=0.99), GaussSeidel(tolerance=1e-11)
    solution = solve(model, task, Behavior(BoltzmannAverage(), 1.0), options=SolveOptions(solver=solver))
    order = np.asarray(solution.start.order)
    values = np.asarray(solution.values)[order]
    backup, positions = NativeBackup(KERNELS[BoltzmannAverage], one, 0 * one), np.arange(420, dtype=np.int32)
    process = numbered_process(model, task, order)
    loop = SweepLoop(
        process, values.copy(), positions.copy(), positions, backup, NO_COSTS, np.float64(1e-11), 1000, 1000
    )
    assert loop.run().converged
    return loop, values


def test_sweep_loop_run_finally_skips_no_state():
    """States that seem up to date, because no change was recorded, are still solved."""
    loop, values = converged_loop()
    loop.values[1:] *= 0.5
    loop.history.last_changed[:], loop.history.last_solved[:] = 0, loop.number
    assert loop.run().converged
    np.testing.assert_allclose(loop.values, values, rtol=1e-8)


def test_sweep_loop_jacobi_sweep_leaves_changed_states_and_neighbors_to_be_solved():
    """None of them saw what the others became, wherever they stand in the order."""
    loop, _ = converged_loop()
    loop.values[1:] *= 0.5
    loop.jacobi_sweep()
    process, history = loop.process, loop.history
    changed = history.last_changed == loop.number
    near = changed | changed[process.successors].any(axis=(1, 2))
    assert near.sum() > 0
    before = loop.values.copy()
    loop.sweep(np.flatnonzero(near).astype(np.int32), shift_from=len(before))
    assert (history.last_solved[near & ~process.terminal] == loop.number).all()
    assert (loop.values != before)[near & ~process.terminal].mean() > 0.9
