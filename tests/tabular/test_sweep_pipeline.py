"""Work in parallel gives the same bits: pipelined sweeps, tasks in a batch and alone; and what a failure does."""

import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.numbered_worlds import NO_COSTS, host_process, numbered_process, order_of
from sidestep.tabular.backups import Behavior, BoltzmannAverage, LogSumExp
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.solve import SolveOptions, solve
from sidestep.tabular.solvers import native
from sidestep.tabular.solvers.gauss_seidel import GaussSeidel
from sidestep.tabular.solvers.native import BOLTZMANN, LOG_SUM_EXP, NativeBackup, cores, run_parallel
from sidestep.tabular.solvers.sweep_loop import SweepLoop, pipeline
from sidestep.tabular.tasks import reach, stack_tasks
from sidestep.worlds.offices import office


def a_sweep(values, bandwidth, number, log):
    """A sweep that makes of each value a mixture of those within the bandwidth, and shifts the farther ones."""

    def sweep(block):
        for i in block:
            low, high = max(0, i - bandwidth), min(len(values), i + bandwidth + 1)
            values[i] = 0.3 * values[i] + np.cos(values[low:high].sum() + number)
            values[i + 1 : high] += 0.01 * values[i]
        log.append((number, int(block[-1])))
        return values[block].sum()

    return sweep


@given(
    states=st.integers(1, 60),
    bandwidth=st.integers(0, 8),
    size=st.integers(1, 12),
    left_out=st.sets(st.integers(0, 59)),
)
@settings(deadline=None)
def test_pipeline_random_sweeps_equals_one_after_the_other(states, bandwidth, size, left_out):
    positions = np.setdiff1d(np.arange(states), list(left_out - {0}))
    blocks = np.split(positions, range(size, len(positions), size))
    first = np.random.default_rng(0).normal(size=states)

    one_by_one, ends = first.copy(), [0]
    sweeps = [a_sweep(one_by_one, bandwidth, number, []) for number in (1, 2)]
    expected = [[sweep(block) for block in blocks] for sweep in sweeps]

    together, seen, between = first.copy(), np.full(states, np.nan), first.copy()
    for block in blocks:
        a_sweep(between, bandwidth, 1, [])(block)

    def on_progress(end):
        seen[ends[-1] : end] = together[ends[-1] : end]
        ends.append(end)

    leading, following = (a_sweep(together, bandwidth, number, []) for number in (1, 2))
    results = pipeline(leading, following, on_progress, blocks, bandwidth)
    np.testing.assert_array_equal(results, expected)
    np.testing.assert_array_equal(together, one_by_one)
    # what progress reports is what the first sweep leaves
    np.testing.assert_array_equal(seen[: positions[-1] + bandwidth + 1], between[: positions[-1] + bandwidth + 1])


def test_pipeline_narrow_band_overlaps_the_sweeps():
    values, log, ends = np.zeros(100), [], []
    leading, following = (a_sweep(values, 3, number, log) for number in (1, 2))
    pipeline(leading, following, ends.append, np.split(np.arange(100), 10), 3)
    assert log.index((2, 9)) < log.index((1, 99))
    assert ends[0] == 0
    assert ends[-1] >= 100
    assert [end for number, end in log if number == 2] == list(range(9, 100, 10))


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "fraction"), [(BOLTZMANN, 1.0), (LOG_SUM_EXP, 0.3)])
def test_sweep_loop_pipelined_equals_waiting(kind, fraction):
    """With a bandwidth of all states, the second sweep waits for the end of the first."""
    random, plan = np.random.default_rng(0), office(160, 160, 3)
    model = half_learned(plan, random)
    task = reach(model.graph, 5_050, discount=0.999, step_cost=1.0)
    order = order_of(model, task)
    positions = np.flatnonzero(random.random(plan.size) < fraction).astype(np.int32)
    process, values = numbered_process(model, task, order), np.where(order == 5_050, 0.0, -1.0)
    backup, greedy = NativeBackup(kind, np.float64(5), np.float64(0)), np.arange(plan.size, dtype=np.int32)
    loops = []
    for bandwidth in (process.bandwidth, 10**9):
        same = process._replace(bandwidth=bandwidth)
        loops.append(
            SweepLoop(same, values.copy(), greedy.copy(), positions, backup, NO_COSTS, np.float64(1e-9), 500, 500)
        )
        assert loops[-1].run().converged
    pipelined, waiting = loops
    assert any(block[-1] + 2 * process.bandwidth < pipelined.blocks[-1][0] for block in pipelined.blocks)
    np.testing.assert_array_equal(pipelined.values, waiting.values)
    for ours, expected in zip(pipelined.history, waiting.history, strict=True):
        np.testing.assert_array_equal(ours, expected)


def test_kernel_sizes_of_a_large_grid_equal_those_of_a_small_one(monkeypatch):
    """Cores count the states of a large grid in parts."""
    monkeypatch.setattr(native, "cores", lambda: 2)
    models = [ObstacleGrid(Grid.unknown(size, size)) for size in (5, 200)]
    small, large = (host_process(model, reach(model.graph, 0)).kernel_sizes() for model in models)
    assert small == large == (4, 2, 1)


def half_learned(plan, random):
    """A model that has half learned where an office's walls are."""
    logits = np.where(plan.known.ravel() > 0, 2.0, -2.0) + random.normal(size=plan.size)
    return ObstacleGrid(Grid.unknown(*plan.shape), jnp.asarray(logits))


@pytest.mark.slow
@pytest.mark.parametrize("backup", [BoltzmannAverage(), LogSumExp()], ids=["Boltzmann", "log-sum-exp"])
def test_solve_batch_equals_each_task_alone(backup):
    """Values, and the gradient from an earlier adjoint: alone a task uses all cores, in a batch one."""
    model = half_learned(office(200, 200, 3), np.random.default_rng(0))
    tasks = [reach(model.graph, goal, discount=0.999, step_cost=1.0) for goal in (20_100, 5_050)]
    behavior, options = Behavior(backup, 5.0), SolveOptions(solver=GaussSeidel(tolerance=1e-7))
    start = GaussSeidel().cold_start(40_000, jnp.dtype(jnp.float64))._replace(adjoint=jnp.ones(40_000))

    def total(parameters, task):
        solution = solve(model.with_parameters(parameters), task, behavior, options=options, start=start)
        return jnp.sum(jnp.cos(jnp.arange(40_000)) * solution.values), solution

    gradient = jax.grad(total, has_aux=True)
    batch = jax.vmap(gradient, (None, 0))(model.parameters, stack_tasks(tasks))
    assert batch[1].converged.all()
    assert jnp.isfinite(batch[0]).all()
    for index, task in enumerate(tasks):
        alone = gradient(model.parameters, task)
        for one, several in zip(jax.tree.leaves(alone), jax.tree.leaves(batch), strict=True):
            np.testing.assert_array_equal(one, several[index])


def test_run_parallel_with_a_failure_waits_for_the_others():
    """They may be writing into memory that is taken back as soon as the failure is known."""
    begun, ended = threading.Event(), []

    def fails():
        begun.wait(1)
        raise ValueError("as it should")

    def works():
        begun.set()
        time.sleep(0.2)
        ended.append(True)

    with pytest.raises(ValueError, match="as it should"):
        run_parallel([fails, works])
    if cores() > 1:
        assert ended
