"""Two sweeps, one behind the other: they find what they would have found one after the other."""

import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.numbered_worlds import numbered_world, order_of
from sidestep.tabular.backups import BACKUPS, Behavior
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.solve import SolveOptions, solve
from sidestep.tabular.solvers.gauss_seidel import GaussSeidel
from sidestep.tabular.solvers.native import at_once, cores
from sidestep.tabular.solvers.pairs import one_behind_the_other
from sidestep.tabular.solvers.rounds import Rounds
from sidestep.tabular.solvers.value_kernels import BOLTZMANN, LOG_SUM_EXP, Valuing
from sidestep.tabular.tasks import reach, stack_tasks
from sidestep.worlds.offices import office


def a_sweep(values, reach, number, heard):
    """A sweep that makes of each value a mixture of those within reach, and moves the farther ones along with it."""

    def sweep(stretch):
        for i in stretch:
            low, high = max(0, i - reach), min(len(values), i + reach + 1)
            values[i] = 0.3 * values[i] + np.cos(values[low:high].sum() + number)
            values[i + 1 : high] += 0.01 * values[i]
        heard.append((number, int(stretch[-1])))
        return values[stretch].sum()

    return sweep


@given(
    states=st.integers(1, 60),
    reach=st.integers(0, 8),
    size=st.integers(1, 12),
    left_out=st.sets(st.integers(0, 59)),
)
@settings(deadline=None)
def test_a_sweep_behind_another_finds_what_it_would_have_found_after_it(states, reach, size, left_out):
    which = np.setdiff1d(np.arange(states), list(left_out - {0}))
    stretches = np.split(which, range(size, len(which), size))
    first = np.random.default_rng(0).normal(size=states)

    split_by_person, told = first.copy(), []
    expected = [[a_sweep(split_by_person, reach, number, [])(stretch) for stretch in stretches] for number in (1, 2)]

    together, seen = first.copy(), np.full(states, np.nan)
    between = first.copy()
    for stretch in stretches:
        a_sweep(between, reach, 1, [])(stretch)

    def settled(end):
        told.append(end)
        begin = told[-2] if len(told) > 1 else 0
        seen[begin:end] = together[begin:end]

    leading, following = (a_sweep(together, reach, number, []) for number in (1, 2))
    found = one_behind_the_other(leading, following, settled, stretches, reach)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(together, split_by_person)
    # what is settled is what the first sweep leaves
    np.testing.assert_array_equal(seen[: which[-1] + reach + 1], between[: which[-1] + reach + 1])


def test_the_second_sweep_does_not_wait_for_the_end_of_the_first():
    values, heard, settled = np.zeros(100), [], []
    leading, following = (a_sweep(values, 3, number, heard) for number in (1, 2))
    one_behind_the_other(leading, following, settled.append, np.split(np.arange(100), 10), 3)
    began, ended = heard.index((2, 9)), heard.index((1, 99))
    assert began < ended
    assert settled[0] == 0
    assert settled[-1] >= 100
    assert [end for number, end in heard if number == 2] == list(range(9, 100, 10))


@pytest.mark.parametrize("share", [1.0, 0.3])
@pytest.mark.parametrize("kind", [BOLTZMANN, LOG_SUM_EXP])
def test_real_sweeps_find_what_they_would_have_found_one_after_the_other(kind, share):
    """With a reach that spans all states, the second sweep waits for the end of the first."""
    world, values, favourite, which = numbered_office(share)
    valuing = Valuing(kind, np.float64(5), np.float64(0))
    found = []
    for split_by_person in (world.reach, 10**9):
        rounds = Rounds(
            world._replace(reach=split_by_person),
            values.copy(),
            favourite.copy(),
            which,
            valuing,
            np.float64(1e-9),
            500,
            500,
        )
        assert rounds.until_still().converged
        found.append(rounds)
    overlapping, waiting = found
    stretches = overlapping.stretches
    assert any(stretch[-1] + 2 * world.reach < stretches[-1][0] for stretch in stretches)
    np.testing.assert_array_equal(overlapping.values, waiting.values)
    for mine, expected in zip(overlapping.marks, waiting.marks, strict=True):
        np.testing.assert_array_equal(mine, expected)


def half_learned(plan, random):
    """A model that has half learned where an office's walls are."""
    logits = np.where(plan.known.ravel() > 0, 2.0, -2.0) + random.normal(size=plan.size)
    return ObstacleGrid(Grid.unknown(*plan.shape), jnp.asarray(logits))


def numbered_office(share):
    """A half-learned office in order of distance, first values, and the positions of a share of its states."""
    random, plan = np.random.default_rng(0), office(160, 160, 3)
    model = half_learned(plan, random)
    wanted = reach(model.graph, 5_050, discount=0.999, step_cost=1.0)
    order = order_of(model, wanted)
    which = np.flatnonzero(random.random(plan.size) < share).astype(np.int32)
    values = np.where(order == 5_050, 0.0, -1.0)
    return numbered_world(model, wanted, order), values, np.arange(plan.size, dtype=np.int32), which


@pytest.mark.parametrize("name", ["boltzmann", "logsumexp"])
def test_a_task_is_solved_alike_alone_and_in_a_batch(name):
    """Alone its sweeps share the cores; in a batch they come one after another. Not a bit may differ."""
    model = half_learned(office(200, 200, 3), np.random.default_rng(0))
    wanted = [reach(model.graph, goal, discount=0.999, step_cost=1.0) for goal in (20_100, 5_050)]
    people, solver = Behavior(BACKUPS[name](), 5.0), GaussSeidel(tolerance=1e-9)
    batch = solve(model, stack_tasks(wanted), people, options=SolveOptions(solver=solver))
    assert batch.converged.all()
    for index, task in enumerate(wanted):
        alone = solve(model, task, people, options=SolveOptions(solver=solver))
        for one, several in zip(jax.tree.leaves(alone), jax.tree.leaves(batch), strict=True):
            np.testing.assert_array_equal(one, several[index])


@pytest.mark.parametrize("name", ["boltzmann", "logsumexp"])
def test_a_gradient_is_found_alike_alone_and_in_a_batch(name):
    """From an earlier adjoint: alone, what it takes of the states is worked out on all cores."""
    model = half_learned(office(200, 200, 3), np.random.default_rng(0))
    wanted = [reach(model.graph, goal, discount=0.999, step_cost=1.0) for goal in (20_100, 5_050)]
    people, solver = Behavior(BACKUPS[name](), 5.0), GaussSeidel(tolerance=1e-7)
    before = solver.cold_start(40_000, jnp.dtype(jnp.float64))._replace(adjoint=jnp.ones(40_000))

    def total(parameters, task):
        found = solve(
            model.with_parameters(parameters), task, people, options=SolveOptions(solver=solver), start=before
        )
        return jnp.sum(jnp.cos(jnp.arange(40_000)) * found.values)

    slope = jax.grad(total)
    batch = jax.vmap(slope, (None, 0))(model.parameters, stack_tasks(wanted))
    assert jnp.isfinite(batch).all()
    for index, task in enumerate(wanted):
        np.testing.assert_array_equal(batch[index], slope(model.parameters, task))


def test_what_fails_waits_for_what_is_still_at_work():
    """It may be writing into memory that is taken back as soon as the failure is known."""
    begun, ended = threading.Event(), []

    def fails():
        begun.wait(1)
        raise ValueError("as it should")

    def works():
        begun.set()
        time.sleep(0.2)
        ended.append(True)

    with pytest.raises(ValueError, match="as it should"):
        at_once([fails, works])
    if cores() > 1:
        assert ended
