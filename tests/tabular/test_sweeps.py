"""What ordered sweeps are made of: orders, the machine code beside the formulas that it repeats, and rounds."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numba
import numpy as np
import pytest
from numba.core import config as numba_settings

from helpers.numbered_worlds import numbered_world, order_of, some_map
from helpers.problems import BACKUPS, generic_task, random_problem
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.solve import SolveOptions, solve
from sidestep.tabular.solvers.adjoint_kernels import Weighing, weigh
from sidestep.tabular.solvers.base import neg_inf
from sidestep.tabular.solvers.compiled import compiled
from sidestep.tabular.solvers.gauss_seidel import KERNELS, GaussSeidel
from sidestep.tabular.solvers.ordering import _ascending
from sidestep.tabular.solvers.rounds import Rounds
from sidestep.tabular.solvers.value_kernels import Scratch, Valuing, backed_up
from sidestep.tabular.tasks import reach

each_backup = pytest.mark.parametrize("name", BACKUPS)


# Orders


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
    position, successors = np.argsort(order), np.asarray(model.graph.successors)
    found = numbered_world(model, reach(model.graph, 5, discount=0.99), order).reach
    assert found == np.abs(position[successors] - position[:, None, None]).max()


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
        by_beta[i] = weigh(valuing, exact, Weighing(q[i], weights[i], policy[i]))
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
    q = np.array([[-1.0, neg_inf(jnp.dtype(jnp.float64)), -2.0]])
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


# Rounds


def test_the_last_sweep_leaves_nobody_out():
    """States that seem to have nothing to do, because nobody said that values changed, are still looked at."""
    rounds, solved = settled_rounds()
    rounds.values[1:] *= 0.5
    rounds.marks.changed[:], rounds.marks.solved[:] = 0, rounds.number
    assert rounds.until_still().converged
    np.testing.assert_allclose(rounds.values, solved, rtol=1e-8)


def settled_rounds():
    """Rounds that have come to rest, and the values that they were at."""
    model, one = some_map(), np.float64(1)
    wanted = reach(model.graph, 5, discount=0.99)
    found = solve(
        model, wanted, Behavior(BoltzmannAverage(), 1.0), options=SolveOptions(solver=GaussSeidel(tolerance=1e-11))
    )
    order = np.asarray(found.start.order)
    world = numbered_world(model, wanted, order)
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
