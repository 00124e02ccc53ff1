"""The sizes of batches, where memory is counted in probabilities of one task."""

import jax
import numpy as np
import pytest

from sidestep.inference.batching import make_batches, plan_batches
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.behavior_model import behavior_model
from sidestep.tabular.demonstrations import Trajectory, gather
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.solvers.gauss_seidel import GaussSeidel
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import reach

BLANK = Grid.unknown(4, 6)
MODEL = ObstacleGrid(BLANK)
ONE_TASK = BLANK.size * 4 * 2 * 8.0
"""The bytes of the probabilities: four actions, two outcomes, numbers of eight bytes."""


@pytest.mark.parametrize(("large_map", "size"), [(BLANK.size, 5), (BLANK.size + 1, 8)])
def test_plan_batches_rounds_a_single_batch_of_maps_that_are_not_large(large_map, size):
    for solver in (Jacobi(), GaussSeidel()):
        assert plan_batches(MODEL, solver, 5, large_map=large_map).size == size


@pytest.mark.parametrize(("tasks", "memory", "size"), [
    (5, 90, 5),  # five tasks fit, eight do not
    (5, 120, 8),
    (6, 72, 3),  # five tasks fit: two batches of three, not of four
    (6, 40, 2),
    (1, 1, 1),
])  # fmt: skip
def test_plan_batches_fills_memory_with_equal_batches(tasks, memory, size):
    """A solve by sweeps and its gradient take 12 times the probabilities, and all of them 8 times."""
    assert plan_batches(MODEL, Jacobi(), tasks, memory=memory * ONE_TASK).size == size


def test_plan_batches_of_gauss_seidel_are_larger():
    sizes = [plan_batches(MODEL, solver, 64, memory=80 * ONE_TASK).size for solver in (Jacobi(), GaussSeidel())]
    assert sizes[1] > 2 * sizes[0]


@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_make_batches_are_the_tasks_in_order_and_ended_ones(size):
    goals, person = (0, 5, 23), np.array([1, 0, 1])
    walks = [Trajectory(np.array([8, 9, 10][: 2 + number]), np.full(1 + number, 3), number) for number in (0, 1)]
    shown = gather(walks, [reach(BLANK, goal) for goal in goals])
    agents = behavior_model(Behavior(BoltzmannAverage()), ["beta"], person=person)
    batches = make_batches(shown, agents, size)
    assert len(batches) == -(-3 // size)
    whole = jax.tree.map(lambda *leaves: np.concatenate(leaves), *batches)
    assert len(whole.person) == size * len(batches)
    np.testing.assert_array_equal(whole.person[:3], person)
    np.testing.assert_array_equal(whole.choices.counts.sum(axis=1)[:3], [1, 2, 0])
    np.testing.assert_array_equal(whole.tasks.terminal[:3], shown.tasks.terminal)
    assert whole.tasks.terminal[3:].all()
    assert not whole.choices.counts[3:].any()
    alone = make_batches(shown, behavior_model(Behavior(BoltzmannAverage())), size)
    assert not np.concatenate([batch.person for batch in alone]).any()
