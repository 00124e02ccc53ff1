"""Two sweeps, one behind the other: they find what they would have found one after the other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sidestep.domains.offices import office
from sidestep.tabular.backups import BACKUPS, Behavior
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.solve import solve
from sidestep.tabular.solvers.ordered import Ordered
from sidestep.tabular.solvers.pairs import one_behind_the_other
from sidestep.tasks import reach, stack_tasks


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

    apart, told = first.copy(), []
    expected = [[a_sweep(apart, reach, number, [])(stretch) for stretch in stretches] for number in (1, 2)]

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
    np.testing.assert_array_equal(together, apart)
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


@pytest.mark.parametrize("name", ["boltzmann", "logsumexp"])
def test_a_task_is_solved_alike_alone_and_in_a_batch(name):
    """Alone its sweeps share the cores; in a batch they come one after another. Not a bit may differ."""
    grid = office(200, 200, 3)
    logits = np.where(grid.known.ravel() > 0, 2.0, -2.0) + np.random.default_rng(0).normal(size=grid.size)
    model = ObstacleGrid(type(grid).unknown(*grid.shape), jnp.asarray(logits))
    wanted = [reach(model.graph, goal, discount=0.999, step_cost=1.0) for goal in (20_100, 5_050)]
    people, solver = Behavior(BACKUPS[name](), 5.0), Ordered(tolerance=1e-9)
    batch = solve(model, stack_tasks(wanted), people, solver=solver)
    assert batch.converged.all()
    for index, task in enumerate(wanted):
        alone = solve(model, task, people, solver=solver)
        for one, several in zip(jax.tree.leaves(alone), jax.tree.leaves(batch), strict=True):
            np.testing.assert_array_equal(one, several[index])
