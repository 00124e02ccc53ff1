"""Barriers: the transitions that they say a model has are those of the model."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.barrier_worlds import KINDS, RIGHT, model_of
from helpers.problems import FAMILIES, PROBLEMS, TURNS, dense
from sidestep.errors import InputError
from sidestep.tabular.graph import graph
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import FIXED, ObstacleGrid, SlipperyGrid, TiedModel, road_network, walled_grid
from sidestep.tabular.models.barriers import NO_BARRIER, Barriers, barriers_of, with_closed


def transitions(barriers: Barriers, closed: np.ndarray) -> np.ndarray:
    """T[s, a, s′] by the formula of the module, one attempt after the other."""
    states, actions, attempts = barriers.successors.shape
    surely = np.where(barriers.known == Cell.OCCUPIED, 1.0, np.where(barriers.known == Cell.FREE, 0.0, closed))
    result = np.zeros((states, actions, states))
    for s, a, k in np.ndindex(states, actions, attempts):
        success = barriers.attempts[s, a, k]
        for needed in barriers.needed[s, a, k]:
            success *= 1 if needed == NO_BARRIER else 1 - surely[needed]
        result[s, a, barriers.successors[s, a, k]] += success
        result[s, a, s] -= success
    result[np.arange(states), :, np.arange(states)] += 1
    return result


def a_model(kind, shape: tuple[int, int], random):
    """A model with what is known, terrain or the numbers of links at random."""
    known = random.choice([int(cell) for cell in Cell], shape)
    if kind == "borders":
        return walled_grid(Grid(np.full(shape, int(Cell.UNKNOWN))))
    if kind == "turns":
        return road_network(random.permutation(5)[TURNS], np.ones(5), by_turn=bool(random.integers(2)))
    if kind == "slips":
        terrain = np.where(random.random(shape) < 0.4, -1, 0)
        terrain[0, 0] = 0
        return SlipperyGrid(Grid(known, connectivity=8 if shape[1] == 3 else 4), slip=random.normal(), terrain=terrain)
    return ObstacleGrid(Grid(known, connectivity=8 if kind == "8 moves" else 4))


@pytest.mark.parametrize("kind", KINDS)
@given(shape=st.sampled_from([(1, 3), (3, 2), (3, 4)]), seed=st.integers(0, 2**16))
@settings(max_examples=15)
def test_barriers_of_random_models_have_their_transitions(kind, shape: tuple[int, int], seed):
    random = np.random.default_rng(seed)
    model = a_model(kind, shape, random)
    barriers = barriers_of(model)
    closed = random.uniform(0.001, 0.999, len(barriers.known))
    np.testing.assert_allclose(transitions(barriers, closed), dense(with_closed(model, closed)), atol=1e-12)


@pytest.mark.parametrize("name", ["4-connected", "8-connected", "walls between cells", "links", "turns", "slips"])
def test_barriers_of_a_model_have_its_transitions_by_the_dense_formula(name):
    """Beside formulas that are written down apart from the library."""
    problem = (PROBLEMS | FAMILIES)[name]
    barriers, theta = barriers_of(problem.model), np.asarray(problem.model.parameters)
    closed = 1 / (1 + np.exp(-theta[: len(barriers.known)]))
    np.testing.assert_allclose(transitions(barriers, closed), problem.dense(theta), atol=1e-12)


def test_barriers_of_cells_have_the_shape_and_what_is_known():
    known = np.array([[-1, 0, 1], [0, -1, -1]])
    for model in (ObstacleGrid(Grid(known)), SlipperyGrid(Grid(known))):
        barriers = barriers_of(model)
        assert barriers.shape == (2, 3)
        np.testing.assert_array_equal(barriers.known, known.ravel())
    assert barriers_of(model_of("borders")).shape is None


def test_barriers_of_a_diagonal_move_need_both_cells_beside_it():
    needed = barriers_of(ObstacleGrid(Grid.unknown(2, 2, 8))).needed
    assert set(needed[0, 7, 0]) == {1, 2, 3}  # down to the right
    assert set(needed[0, RIGHT, 0]) == {1, NO_BARRIER}


STEPS = graph(np.array([[[1, 0]], [[1, 1]]]))
OTHER_FORMS = {
    "a table": PROBLEMS["tabular"].model,
    "many outcomes": FAMILIES["tied"].model,
    "staying first": TiedModel(graph(np.array([[[0, 1]], [[1, 1]]])), np.array([[[FIXED, 0]], [[FIXED, 0]]])),
    "a logit of moving": TiedModel(STEPS, np.array([[[0, FIXED]], [[0, FIXED]]])),
    "two logits": TiedModel(STEPS, np.array([[[0, 1]], [[0, 1]]])),
}


@pytest.mark.parametrize("name", OTHER_FORMS)
def test_barriers_of_another_model_raises(name):
    with pytest.raises(InputError, match=r"model.*expected.*walled_grid"):
        barriers_of(OTHER_FORMS[name])


@pytest.mark.parametrize("kind", KINDS)
def test_with_closed_sets_probabilities_and_keeps_the_rest(kind):
    model = model_of(kind)
    count = len(barriers_of(model).known)
    closed = np.linspace(0.01, 0.99, count)
    changed = with_closed(model, closed)
    assert type(changed) is type(model)
    np.testing.assert_allclose(1 / (1 + jnp.exp(-changed.parameters[:count])), closed, rtol=1e-9)
    np.testing.assert_array_equal(changed.parameters[count:], model.parameters[count:])
