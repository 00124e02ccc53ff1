"""Transition models of tables, roads and slippery floors: probabilities written out, and what they refuse."""

import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.tabular.graph import graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import FIXED, IMPOSSIBLE, ObstacleGrid, SlipperyGrid, TabularModel, TiedModel, road_network
from sidestep.tabular.models.categorical import tabular_model
from sidestep.tabular.models.roads import closed

WORLD = graph([[[0, 1], [1, 0]], [[1, 0], [0, 1]]])
TABLE = np.array([[[0.25, 0.75], [1.0, 0.0]], [[0.5, 0.5], [0.1, 0.9]]])


def sigmoid(x):
    return 1 / (1 + np.exp(-np.asarray(x)))


def test_tabular_model_has_the_probabilities_it_was_made_with():
    for known in (False, True, np.array([[True, False], [False, True]])):
        model = tabular_model(WORLD, TABLE, known)
        np.testing.assert_allclose(model.probabilities(), TABLE, rtol=1e-12)
        learned = 4 if known is False else int((~np.broadcast_to(known, (2, 2))).sum())
        assert model.parameters.reshape(-1, 2).shape == (learned, 2)


def test_tabular_model_with_known_rows_learns_the_others():
    model = tabular_model(WORLD, TABLE, np.array([[True, False], [False, True]]))
    changed = np.asarray(model.with_parameters(jnp.array([[3.0, 5.0], [1.0, -1.0]])).probabilities())
    np.testing.assert_allclose(changed[[0, 1], [0, 1]], TABLE[[0, 1], [0, 1]])
    np.testing.assert_array_equal(changed[0, 1], [1, 0])  # what is impossible stays so
    np.testing.assert_allclose(changed[1, 0], [sigmoid(2), sigmoid(-2)])


@pytest.mark.parametrize(("table", "message"), [
    (TABLE[:1], "probabilities"),
    (TABLE - np.array([1e-3, 0]), "^state 0, action 0, field 'probabilities': expected probabilities that sum to 1"),
    (np.where(TABLE == 0.9, 0.91, TABLE), "^state 1, action 1, .*: expected .* that sum to 1, found a sum of 1.01"),
    (np.where(TABLE == 0.25, -0.25, TABLE), "probabilities"),
    (np.where(TABLE == 0.25, np.nan, TABLE), "probabilities"),
])  # fmt: skip
def test_tabular_model_of_no_probabilities_raises(table, message):
    with pytest.raises(InputError, match=message):
        tabular_model(WORLD, table)
    tabular_model(WORLD, TABLE + np.array([4e-7, 0]))  # as sums are rounded


INDEX = np.array([[[FIXED, 0], [IMPOSSIBLE, FIXED]], [[1, 0], [1, FIXED]]])


def test_tied_model_shares_logits_and_fixes_others():
    model = TiedModel(WORLD, INDEX, [0.5, -1.0], fixed=2.0)
    p = sigmoid([[2.0 - 0.5, 0.0], [-1.5, -3.0]])
    p[0, 1] = 0
    np.testing.assert_allclose(model.probabilities(), np.stack([p, 1 - p], axis=-1), rtol=1e-12)
    assert TiedModel(WORLD, INDEX).parameters.shape == (2,)
    assert TiedModel(WORLD, INDEX, np.zeros(3)).parameters.shape == (3,)
    assert TiedModel(WORLD, np.full((2, 2, 2), FIXED)).parameters.shape == (0,)
    fixed = np.arange(8.0).reshape(2, 2, 2)
    np.testing.assert_allclose(TiedModel(WORLD, INDEX, fixed=fixed).probabilities()[0, 0], [0.5, 0.5])
    np.testing.assert_allclose(TiedModel(WORLD, INDEX, fixed=fixed).probabilities()[1, 1], [sigmoid(-7), sigmoid(7)])


@pytest.mark.parametrize(("index", "logits", "message"), [
    (np.where(INDEX == IMPOSSIBLE, IMPOSSIBLE - 1, INDEX), 0.0, "index"),
    (INDEX[:, :1], 0.0, "index"),
    (INDEX, [0.5], "logits"),
    (np.where(INDEX[..., :1] == IMPOSSIBLE, IMPOSSIBLE, INDEX), 0.0, r"found none at \[\[0, 1\]\]"),
    (INDEX, [0.5, np.nan], "logits"),
])  # fmt: skip
def test_tied_model_of_another_index_raises(index, logits, message):
    with pytest.raises(InputError, match=message):
        TiedModel(WORLD, index, logits)


def test_tabular_model_with_an_action_without_outcomes_raises():
    possible = np.ones((2, 2, 2), bool)
    possible[1, 0] = False
    with pytest.raises(InputError, match=r"found none at \[\[1, 0\]\]"):
        TabularModel(WORLD, jnp.zeros((2, 2, 2)), possible)


def test_road_network_actions_are_turns_in_their_order():
    turns, lengths, logits = [[2, 0], [0, 1], [0, 2], [1, 0]], [1.0, 2.0, 4.0], np.array([0.5, -1.0, 2.0, 3.0])
    for by_turn, own in ((False, logits[:3]), (True, logits)):
        model = road_network(turns, lengths, own, by_turn=by_turn)
        world, probabilities = model.graph, np.asarray(model.probabilities())
        assert np.asarray(world.available).tolist() == [[True, True], [True, False], [True, False]]
        for number, (begin, onto) in enumerate(turns):
            action = [other for other in turns if other[0] == begin].index([begin, onto])
            assert np.asarray(world.successors)[begin, action].tolist() == [onto, begin]
            shut = sigmoid(own[number if by_turn else onto])
            np.testing.assert_allclose(probabilities[begin, action], [1 - shut, shut], rtol=1e-12)
            assert np.asarray(world.lengths)[begin, action] == lengths[onto]
        np.testing.assert_allclose(closed(model), sigmoid(own))
    # a link that leads nowhere stays where it is
    dead = road_network([[0, 1]], [1.0, 2.0])
    assert np.asarray(dead.graph.available).all()
    assert np.asarray(dead.probabilities())[1, 0] @ np.asarray(dead.graph.successors)[1, 0] == 1
    assert float(dead.graph.lengths[1, 0]) == 3


@pytest.mark.parametrize(("turns", "lengths", "field"), [
    (np.zeros((0, 2), int), [1.0], "turns"),
    ([[0, 1], [0, 1]], [1.0, 1.0], "turns"),
    ([[0, 2]], [1.0, 1.0], "turns"),
    ([[-1, 0]], [1.0, 1.0], "turns"),
    ([[0, 1]], [1.0, 0.0], "lengths"),
])  # fmt: skip
def test_road_network_of_other_roads_raises(turns, lengths, field):
    with pytest.raises(InputError, match=field):
        road_network(turns, lengths)


def test_slippery_grid_has_the_slip_of_each_terrain_and_what_is_blocked():
    terrain, logits = np.array([[0, 1, -1]]), np.array([0.3, -2.0, 1.0])
    model = SlipperyGrid(Grid(np.array([[-1, 0, 1]])), logits, np.array([-1.0, 0.5]), terrain)
    np.testing.assert_allclose(model.slip, sigmoid([-1.0, 0.5]))
    np.testing.assert_allclose(model.blocked, [[sigmoid(0.3), 0, 1]])
    np.testing.assert_allclose(ObstacleGrid(Grid(np.array([[-1, 0, 1]])), logits).blocked, model.blocked)
    # to the right of the first cell lies a free one; at its sides are the edges of the map, where moves do not fail
    slips = sigmoid(-1.0)
    expected = np.array([1 - slips, slips / 2, slips / 2, 0.0])
    np.testing.assert_allclose(np.asarray(model.probabilities())[0, 3], expected, atol=1e-12)
    np.testing.assert_array_equal(np.asarray(model.graph.successors)[0, 3], [1, 0, 0, 0])
    np.testing.assert_allclose(np.asarray(model.probabilities())[2].sum(axis=-1), 1)
    assert np.asarray(model.probabilities())[2, 2, 0] == pytest.approx(1)  # no slips there


@pytest.mark.parametrize("terrain", [[[0, 2, 0]], [[1, 1, 1]], [[-1, -1, -1]], [[0, -2, 0]], [[0], [0], [0]]])
def test_slippery_grid_of_other_terrains_raises(terrain):
    with pytest.raises(InputError, match="terrain"):
        SlipperyGrid(Grid.unknown(1, 3), terrain=np.array(terrain))
