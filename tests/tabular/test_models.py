"""Grids, graphs and transition models: geometry, which cells a move needs, and their probabilities."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.problems import dense, dense_obstacles, dense_tabular, random_problem
from sidestep.errors import InputError
from sidestep.tabular.graph import graph, grid_graph
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid, SlipperyGrid, TabularModel, closed, road_network, true_model

seeds = st.integers(0, 2**32 - 1)
connectivities = pytest.mark.parametrize("connectivity", [4, 8])
U, F, O = Cell.UNKNOWN, Cell.FREE, Cell.OCCUPIED  # noqa: E741


# Grids


def test_centers_and_states_of_a_grid_follow_the_convention():
    """Cell (column c, row from the bottom r) has its center at origin + ((c+.5), (r+.5))·resolution."""
    grid = Grid(np.full((3, 4), U), resolution=0.5, origin=(10.0, -2.0, 0.0))
    for row in range(3):
        for column in range(4):
            center = np.array([[10 + (column + 0.5) * 0.5, -2 + (2 - row + 0.5) * 0.5]])
            assert grid.states(center).tolist() == [row * 4 + column]
            np.testing.assert_allclose(grid.centers(np.array([row * 4 + column])), center)


def test_centers_of_a_rotated_grid_are_rotated():
    """A quarter turn: the map's columns run up, its rows (from the bottom) to the left."""
    grid = Grid(np.full((2, 3), U), origin=(1.0, 1.0, np.pi / 2))
    np.testing.assert_allclose(grid.centers(np.array([3, 5, 0])), [[0.5, 1.5], [0.5, 3.5], [-0.5, 1.5]])
    assert grid.contains(np.array([[0.5, 3.9], [1.5, 1.5]])).tolist() == [True, False]


@given(seed=seeds, yaw=st.floats(-4, 4), resolution=st.floats(0.01, 10))
def test_states_of_centers_are_the_inverse(seed, yaw, resolution):
    rng = np.random.default_rng(seed)
    grid = Grid(np.full(rng.integers(1, 9, 2), U), resolution, (*rng.normal(0, 20, 2).tolist(), yaw))
    states = np.arange(grid.size)
    assert (grid.states(grid.centers(states)) == states).all()
    inside = rng.uniform(0, 1, (20, 2)) * grid.shape[::-1]
    np.testing.assert_allclose(grid.to_cell_units(grid.to_metres(inside)), inside, atol=1e-8)
    assert grid.contains(grid.to_metres(inside)).all()


def test_contains_includes_the_border_only():
    grid = Grid.unknown(2, 3)
    assert grid.states(np.array([[0.0, 0.0], [3.0, 2.0]])).tolist() == [3, 2]
    outside = np.array([[3.1, 1.0], [1.0, -0.1], [np.nan, 1.0], [np.inf, 1.0]])
    assert not grid.contains(outside).any()
    with pytest.raises(InputError, match=r"row 2.*y in 0 to 2 m, found \[3\.1, 1\.0\]"):
        grid.states(np.array([[1.0, 1.0], [3.1, 1.0]]))


@pytest.mark.parametrize(("field", "change"), [
    ("known", {"known": np.zeros((0, 3), dtype=np.int64)}),
    ("known", {"known": np.array([[2]])}),
    ("resolution", {"resolution": 0.0}),
    ("resolution", {"resolution": float("nan")}),
    ("origin", {"origin": (0.0, float("inf"), 0.0)}),
    ("connectivity", {"connectivity": 6}),
])  # fmt: skip
def test_grid_of_a_wrong_field_raises(field, change):
    fields = {"known": np.array([[-1]]), **change}
    if field == "connectivity":  # refused by its type before, where types are checked
        with pytest.raises(Exception, match="connectivity"):
            Grid(**fields)
    else:
        with pytest.raises(InputError, match=field):
            Grid(**fields)


def test_forget_keeps_all_but_the_cells():
    grid = Grid(np.array([[F, O]]), 0.5, (1.0, 2.0, 0.1), 8)
    forgotten = grid.forget()
    assert (forgotten.known == U).all()
    assert (forgotten.resolution, forgotten.origin, forgotten.connectivity) == (0.5, (1.0, 2.0, 0.1), 8)


# Graphs


def test_grid_graph_lengths_of_diagonals_are_longer():
    root = np.sqrt(2)
    np.testing.assert_allclose(grid_graph(Grid.unknown(2, 2, 8)).lengths, [[1, 1, 1, 1, root, root, root, root]])
    np.testing.assert_array_equal(graph(np.zeros((1, 2, 1), dtype=np.int64)).lengths, [[1.0]])


@pytest.mark.parametrize("successors", [np.zeros((0, 1, 1)), [[[2]], [[0]]], [[[-1]], [[0]]]])
def test_graph_of_wrong_successors_raises(successors):
    with pytest.raises(InputError, match="successors"):
        graph(np.asarray(successors, dtype=np.int64))


# Obstacle grids


@connectivities
@given(seed=seeds)
def test_obstacle_grid_probabilities_are_products_over_needed_cells(connectivity, seed):
    rows, columns = 3, 4
    theta = np.random.default_rng(seed).normal(0, 3, rows * columns)
    model = ObstacleGrid(Grid.unknown(rows, columns, connectivity), jnp.asarray(theta))
    np.testing.assert_allclose(model.probabilities().sum(axis=-1), 1, rtol=1e-12)
    np.testing.assert_allclose(dense(model), dense_obstacles(theta, rows, columns, connectivity), atol=1e-12)
    np.testing.assert_allclose(model.blocked, 1 / (1 + np.exp(-theta.reshape(rows, columns))), rtol=1e-12)


@pytest.mark.parametrize(("known", "passes"), [
    ([[F, F], [F, F]], 1.0),
    ([[F, O], [F, F]], 0.0),
    ([[F, F], [O, F]], 0.0),
    ([[F, F], [F, O]], 0.0),
    ([[O, F], [F, F]], 1.0),  # the cell of the agent does not matter
    ([[F, U], [U, U]], 0.5**3),
    ([[U, U], [F, U]], 0.5**2),
])  # fmt: skip
def test_obstacle_grid_diagonals_do_not_cut_corners(known, passes):
    """Down and right from the top left of a 2×2 map; unknown cells are blocked with probability ½."""
    model = ObstacleGrid(Grid(np.array(known), connectivity=8), 0.0)
    assert float(model.probabilities()[0, 7, 0]) == passes
    assert float(model.probabilities()[0, 7, 1]) == 1 - passes


@pytest.mark.slow
def test_obstacle_grid_of_known_cells_keeps_them_constant():
    grid = Grid(np.array([[F, O, U]]))
    model = ObstacleGrid(grid, jnp.asarray([3.0, -3.0, 1.0]))
    assert model.blocked[0, :2].tolist() == [0, 1]
    assert np.isfinite(model.probabilities()).all()
    slope = jax.jacobian(lambda theta: model.with_parameters(theta).probabilities())(model.parameters)
    assert np.isfinite(slope).all()
    assert (slope[..., :2] == 0).all()
    assert (slope[..., 2] != 0).any()


@pytest.mark.parametrize("theta", [-30.0, -100.0])
def test_obstacle_grid_improbable_failures_keep_their_digits(theta):
    """1 − (1 − σ)³ = 3σ − 3σ² + σ³ is far below the rounding of 1."""
    failure = float(ObstacleGrid(Grid.unknown(2, 2, 8), theta).probabilities()[0, 7, 1])
    sigma = np.exp(theta) / (1 + np.exp(theta))
    assert failure == pytest.approx(3 * sigma - 3 * sigma**2 + sigma**3, rel=1e-13, abs=0)


def test_obstacle_grid_improbable_successes_keep_their_digits():
    success = float(ObstacleGrid(Grid.unknown(1, 2), 40.0).probabilities()[0, 3, 0])
    assert success == pytest.approx(np.exp(-40) / (1 + np.exp(-40)), rel=1e-13, abs=0)


def test_true_model_of_unknown_cells_blocks_them():
    assert true_model(Grid(np.array([[F, O, U]]))).blocked.tolist() == [[0, 1, 1]]


# Tabular models


@given(seed=seeds)
def test_tabular_model_probabilities_are_a_softmax_over_outcomes(seed):
    model = random_problem(seed=seed).model
    expected = dense_tabular(model.parameters, np.asarray(model.graph.successors))
    np.testing.assert_allclose(dense(model), expected, atol=1e-12)


@pytest.mark.slow
def test_tabular_model_impossible_outcomes_have_probability_0():
    world = graph(np.array([[[0, 1, 1]], [[0, 1, 0]]]))
    possible = jnp.asarray([[[True, False, True]], [[False, False, True]]])
    model = TabularModel(world, jnp.asarray([[[0.0, 50.0, np.log(3)]], [[9.0, 9.0, -9.0]]]), possible)
    np.testing.assert_allclose(model.probabilities(), [[[0.25, 0, 0.75]], [[0, 0, 1]]], rtol=1e-12)
    slope = jax.jacobian(lambda logits: model.with_parameters(logits).probabilities())(model.parameters)
    assert np.isfinite(slope).all()
    assert (slope[0, 0, :, 0, 0, 1] == 0).all()


def test_tabular_model_of_wrong_shapes_raises():
    world = graph(np.array([[[0, 1]], [[0, 1]]]))
    with pytest.raises(InputError, match=r"of shape \(2, 1, 2\)"):
        TabularModel(world, jnp.zeros((2, 1, 3)))
    with pytest.raises(InputError, match="possible outcome"):
        TabularModel(world, jnp.zeros((2, 1, 2)), jnp.asarray([[[True, True]], [[False, False]]]))


def test_with_parameters_leaves_the_model_as_it_was():
    model = ObstacleGrid(Grid.unknown(1, 2), 0.0)
    moved = model.with_parameters(jnp.asarray([0.0, float(np.log(3))]))
    np.testing.assert_allclose(moved.blocked, [[0.5, 0.75]])
    np.testing.assert_allclose(model.blocked, [[0.5, 0.5]])


# Slippery grids and roads


def test_slippery_grid_in_the_open_slips_half_as_often_to_each_side():
    """From the middle of nine free cells, with P(slip) = .3; and nothing stays."""
    model = SlipperyGrid(Grid(np.full((3, 3), F)), slip=float(np.log(0.3 / 0.7)))
    ahead, to_sides = [1, 7, 3, 5], [(3, 5), (3, 5), (1, 7), (1, 7)]
    expected = np.zeros((4, 9))
    for action, (straight, sides) in enumerate(zip(ahead, to_sides, strict=True)):
        expected[action, straight], expected[action, list(sides)] = 0.7, 0.15
    np.testing.assert_allclose(dense(model)[4], expected, rtol=1e-12, atol=1e-15)


def test_road_network_by_turn_closes_turns_in_the_order_in_which_they_are_given():
    """Turns come in any order; action k of a link is the k-th of its turns."""
    turns = np.array([[2, 0], [0, 1], [1, 0], [0, 2], [1, 2], [2, 1], [0, 0]])
    logits = np.linspace(-2, 2, len(turns))
    shut = 1 / (1 + np.exp(-logits))
    model = road_network(turns, np.ones(3), logits, by_turn=True)
    np.testing.assert_allclose(closed(model), shut, rtol=1e-12)
    actions = [0, 0, 0, 1, 1, 1, 2]
    for (begin, onto), action, probability in zip(turns, actions, shut, strict=True):
        assert model.graph.successors[begin, action].tolist() == [onto, begin]
        np.testing.assert_allclose(model.probabilities()[begin, action], [1 - probability, probability], rtol=1e-12)
