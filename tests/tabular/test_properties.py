"""What must hold for any map, any behavior and any task."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.problems import BACKUPS, random_problem, solve_jit
from sidestep.tabular.backups import Behavior
from sidestep.tabular.graph import graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid, TabularModel
from sidestep.tabular.tasks import Task, reach

pytestmark = pytest.mark.slow

ROWS, COLUMNS = 3, 4

each_backup = pytest.mark.parametrize("name", BACKUPS)
seeds = st.integers(0, 2**32 - 1)
forms = st.sampled_from([{"discount": 0.95}, {"discount": 1.0, "step_cost": 1.0}])


def some_map(rng):
    return Grid.unknown(ROWS, COLUMNS, connectivity=8), rng.normal(-1, 2, (ROWS, COLUMNS))


def values_of(name, grid, theta, goal, form, beta=10.0):
    task = reach(grid, goal, **form)
    solution = solve_jit(ObstacleGrid(grid, jnp.asarray(theta.reshape(-1))), task, Behavior(BACKUPS[name], beta))
    assert solution.converged
    return np.asarray(solution.values).reshape(ROWS, COLUMNS)


@given(seed=seeds, form=forms)
def test_solve_with_more_blocked_cells_lowers_values(seed, form):
    rng = np.random.default_rng(seed)
    grid, theta = some_map(rng)
    before = values_of("hard max", grid, theta, 0, form)
    after = values_of("hard max", grid, theta + rng.choice([0, 0, 1, 5], theta.shape), 0, form)
    assert (after <= before + 1e-8 * np.abs(before)).all()


@each_backup
@given(seed=seeds, form=forms)
def test_solve_of_a_mirrored_map_mirrors_values(name, seed, form):
    rng = np.random.default_rng(seed)
    grid, theta = some_map(rng)
    row, column = divmod(int(rng.integers(grid.size)), COLUMNS)
    values = values_of(name, grid, theta, row * COLUMNS + column, form)
    left_right = values_of(name, grid, theta[:, ::-1], row * COLUMNS + COLUMNS - 1 - column, form)
    up_down = values_of(name, grid, theta[::-1], (ROWS - 1 - row) * COLUMNS + column, form)
    np.testing.assert_allclose(left_right[:, ::-1], values, rtol=1e-7)
    np.testing.assert_allclose(up_down[::-1], values, rtol=1e-7)


@each_backup
@given(seed=seeds)
def test_solve_of_renumbered_states_renumbers_values(name, seed):
    rng = np.random.default_rng(seed)
    model = random_problem(seed=seed).model
    assert isinstance(model, TabularModel)
    order = rng.permutation(model.graph.states)  # new state i is the old state order[i]
    new_name = np.argsort(order)
    renamed = TabularModel(graph(new_name[np.asarray(model.graph.successors)[order]]), model.parameters[order])
    reward, terminal = rng.normal(-1, 0.2, (7, 3)), np.arange(7) == 0
    gamma, behavior = jnp.asarray(0.95), Behavior(BACKUPS[name], 5.0)
    old = Task(jnp.asarray(reward), jnp.ones(7), jnp.asarray(terminal), gamma)
    new = Task(jnp.asarray(reward[order]), jnp.ones(7), jnp.asarray(terminal[order]), gamma)
    expected = solve_jit(model, old, behavior).values[order]
    np.testing.assert_allclose(solve_jit(renamed, new, behavior).values, expected, rtol=1e-7)


@given(seed=seeds, form=forms)
def test_solve_with_each_backup_orders_values(seed, form):
    """Log-sum-exp ≥ hard max ≥ Boltzmann average and mellowmax, as values of every state."""
    rng = np.random.default_rng(seed)
    grid, theta = some_map(rng)
    goal, beta = int(rng.integers(grid.size)), 10 ** rng.uniform(0.5, 2)
    value = {name: values_of(name, grid, theta, goal, form, float(beta)) for name in BACKUPS}
    slack = 1e-7 * np.abs(value["hard max"])
    assert (value["log-sum-exp"] >= value["hard max"] - slack).all()
    assert (value["hard max"] >= value["Boltzmann"] - slack).all()
    assert (value["hard max"] >= value["mellowmax"] - slack).all()
