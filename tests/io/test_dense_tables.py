"""Dense tables of every kind: the model has their probabilities, and the task their values by plain value iteration."""

import equinox as eqx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sidestep.errors import InputError
from sidestep.io.dense_tables import from_dense
from sidestep.tabular.planning import plan

STATES, ACTIONS = 4, 3


def dense(world):
    """P[s, a, s′] of a model."""
    successors, probabilities = np.asarray(world.model.graph.successors), np.asarray(world.model.probabilities())
    table = np.zeros((*successors.shape[:2], len(successors)))
    s, a, k = np.indices(successors.shape)
    np.add.at(table, (s, a, successors[s, a, k]), probabilities)
    return table


def plain_values(P, R, discount, terminal, available):
    """V by value iteration on dense tables; R has an entry for every s, a and s′."""
    reward = np.where(available, (P * np.where(P > 0, R, 0.0)).sum(axis=-1), -np.inf)
    values = np.zeros(len(P))
    for _ in range(400):
        values = np.where(terminal, 0.0, (reward + discount * P @ values).max(axis=-1))
    return values


@st.composite
def tables(draw):
    """P, R(s, a, s′) or R(s, a), terminal and available, with as many successors as there may be."""
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    P = random.dirichlet(np.ones(STATES), size=(STATES, ACTIONS))
    P *= (random.uniform(size=P.shape) < draw(st.sampled_from([0.2, 0.7, 1.0]))) | np.eye(STATES, dtype=bool)[:, None]
    P /= P.sum(axis=-1, keepdims=True)
    terminal = random.uniform(size=STATES) < draw(st.sampled_from([0.0, 0.4]))
    available = random.uniform(size=(STATES, ACTIONS)) < draw(st.sampled_from([0.5, 1.0]))
    available[:, 1] = True
    R = random.normal(size=P.shape if draw(st.booleans()) else (STATES, ACTIONS, 1))
    return P, R, terminal, available


@pytest.mark.slow
@settings(max_examples=12)
@given(tables(), st.sampled_from([0.3, 0.9]), st.booleans())
def test_from_dense_has_the_values_of_its_tables(table, discount, marked):
    P, R, terminal, available = table
    rewards = R if R.shape == P.shape else R[..., 0]
    if marked:
        mask = available if rewards.ndim == 2 else available[..., None]
        world = from_dense(P, np.where(mask, rewards, -np.inf), discount=discount, terminal=terminal)
    else:
        world = from_dense(P, rewards, discount=discount, terminal=terminal, available=available)
    acting = available & ~terminal[:, None]
    np.testing.assert_allclose(dense(world)[acting], P[acting], atol=1e-12)
    assert np.asarray(world.model.possible).sum(axis=-1)[acting].tolist() == (P > 0).sum(axis=-1)[acting].tolist()
    whole = np.broadcast_to(np.asarray(world.model.graph.available), available.shape)
    np.testing.assert_array_equal(whole, available | terminal[:, None])
    solution = plan(world.model, world.task).solution
    np.testing.assert_allclose(solution.values, plain_values(P, R, discount, terminal, available), atol=1e-6)


@pytest.mark.parametrize("terminal", [None, [False, True]])
def test_from_dense_of_state_rewards_has_the_closed_form(terminal):
    """State 0 pays 2 and leads to itself or to 1 with ½ each; 1 pays 6, once where it is terminal, else for ever."""
    world = from_dense([[[0.5, 0.5]], [[0, 1]]], [2, 6], discount=0.5, terminal=terminal)
    last = 6 if terminal else 12
    np.testing.assert_allclose(plan(world.model, world.task).solution.values, [(2 + last / 4) / 0.75, last], rtol=1e-7)


def test_from_dense_keeps_as_many_outcomes_as_an_action_has_at_most():
    P = np.eye(50)[np.random.default_rng(0).permutation(50)][:, None]
    P[3, 0] = 0.0
    P[3, 0, [4, 9, 44]] = 0.25, 0.25, 0.5
    world = from_dense(P, np.zeros(50), discount=0.9)
    assert world.model.graph.successors.shape == (50, 1, 3)
    assert world.model.graph.successors[3, 0].tolist() == [4, 9, 44]
    assert world.model.graph.successors[0, 0].tolist() == [int(np.argmax(P[0, 0]))] * 3
    np.testing.assert_allclose(world.model.probabilities()[3, 0], [0.25, 0.25, 0.5], rtol=1e-12)


def test_from_dense_ignores_rows_that_have_no_meaning():
    """Rows of actions that are not available and of terminal states, and rewards of what is impossible."""
    P, R = np.full((3, 2, 3), np.nan), np.full((3, 2, 3), np.nan)
    P[0, 0], P[1] = [0.0, 0.0, 1.0], [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    R[0, 0, 2], R[1, 0, 0], R[1, 1, 2] = 1.0, 2.0, 3.0
    available = [[True, False], [True, True], [False, False]]
    world = from_dense(P, R, discount=0.5, terminal=[False, False, True], available=available)
    assert world.model.graph.available.tolist() == [[True, False], [True, True], [True, True]]
    np.testing.assert_allclose(plan(world.model, world.task).solution.values, [1.0, 3.0, 0.0], rtol=1e-7)


@pytest.mark.parametrize("dtype", [np.float32, int])
def test_from_dense_takes_numbers_of_other_types(dtype):
    P = np.eye(3)[:, None].astype(dtype)
    assert eqx.tree_equal(
        from_dense(P, [1, 2, 3], discount=0.5), from_dense(np.eye(3)[:, None], [1, 2, 3], discount=0.5)
    )


ROWS = [[[0.5, 0.5], [1.0, 0.0]], [[0.0, 1.0], [0.0, 1.0]]]


def with_row(*row):
    return [ROWS[0], [ROWS[1][0], list(row)]]


NEVER = -np.inf


@pytest.mark.parametrize(
    ("P", "R", "options", "message"),
    [
        (np.full((2, 3, 3), 1 / 3), np.zeros(3), {}, r"'P': .*found shape \(2, 3, 3\); .*np.moveaxis\(P, 0, 1\)"),
        (np.full((3, 2, 2), 1 / 2), np.zeros(3), {}, r"'P': .*found shape \(3, 2, 2\); .*np.moveaxis\(P, 0, 1\)"),
        (np.full((2, 3, 4), 1 / 4), np.zeros(2), {}, r"'P': expected P\[s, a, s′\] .*found shape \(2, 3, 4\)$"),
        (np.eye(2), np.zeros(2), {}, r"'P': expected P\[s, a, s′\] .*found shape \(2, 2\)"),
        (np.zeros((0, 1, 0)), np.zeros(0), {}, r"'P': expected P\[s, a, s′\] .*found shape \(0, 1, 0\)"),
        ([[[1.0], [0.5, 0.5]]], [0.0], {}, "'P': expected numbers, found"),
        ([[["1"]]], [0.0], {}, "'P': expected numbers, found"),
        ([[[1j]]], [0.0], {}, "'P': expected numbers, found complex128"),
        (np.eye(2, dtype=bool)[:, None], np.zeros(2), {}, "'P': expected numbers, found bool"),
        (with_row(0.5, 0.0), np.zeros(2), {}, "^state 1, action 1: expected probabilities that sum to 1, .* 0.5"),
        (with_row(0.5, 1.0), np.zeros(2), {}, "^state 1, action 1: expected probabilities that sum to 1, .* 1.5"),
        (with_row(-0.5, 1.5), np.zeros(2), {}, r"^state 1, action 1: expected probabilities of at least 0.*\[-0.5\]"),
        (with_row(np.nan, 1.0), np.zeros(2), {}, r"^state 1, action 1: expected probabilities of at least 0.*\[nan\]"),
        (with_row(np.inf, -np.inf), np.zeros(2), {}, r"^state 1, action 1: expected probabilities of at least 0"),
        (
            ROWS,
            np.zeros(3),
            {},
            r"'R': expected numbers of shape \(2,\) or \(2, 2\) or \(2, 2, 2\), found shape \(3,\)",
        ),
        (ROWS, np.zeros((2, 2, 1)), {}, r"'R': expected numbers of shape .*found shape \(2, 2, 1\)"),
        (ROWS, [["a", "b"], ["c", "d"]], {}, "'R': expected numbers"),
        (ROWS, [NEVER, 0.0], {}, r"'reward': expected finite numbers, found -inf"),
        (ROWS, [[0.0, np.nan], [0.0, 0.0]], {}, "^state 0, action 1, field 'R': expected finite rewards.*found nan"),
        (ROWS, [[0.0, 0.0], [np.inf, 0.0]], {}, "^state 1, action 0, field 'R': expected finite rewards.*found inf"),
        (ROWS, [[0.0, 0.0], [NEVER, NEVER]], {}, r"'available': .*found none in state \[1\]"),
        (ROWS, [[[0, NEVER]] * 2, [[0, 0]] * 2], {}, "^state 0, action 0, field 'R': expected finite .*found -inf"),
        (ROWS, np.zeros(2), {"terminal": [1]}, r"'terminal': expected booleans of shape \(2,\), found int64 \(1,\)"),
        (ROWS, np.zeros(2), {"terminal": [1, 0]}, r"'terminal': expected booleans of shape \(2,\), found int64 \(2,\)"),
        (ROWS, np.zeros(2), {"available": [True, True]}, r"'available': expected booleans of shape \(2, 2\)"),
        (ROWS, np.zeros(2), {"available": [[True, True], [False, False]]}, r"'available': .*none in state \[1\]"),
        (ROWS, np.zeros(2), {"discount": 1.5}, "'discount': expected a finite number above 0 and at most 1"),
    ],
)
def test_from_dense_of_malformed_tables_raises(P, R, options, message):
    with pytest.raises(InputError, match=message):
        from_dense(P, R, **{"discount": 0.9, **options})


def test_from_dense_of_turned_axes_is_right_after_moveaxis():
    random = np.random.default_rng(0)
    P, R = random.dirichlet(np.ones(3), size=(2, 3)), random.normal(size=(2, 3, 3))
    turned = np.moveaxis(P, 0, 1), np.moveaxis(R, 0, 1)
    world = from_dense(*turned, discount=0.8)
    everywhere = np.ones((3, 2), bool)
    expected = plain_values(*turned, 0.8, np.zeros(3, bool), everywhere)
    np.testing.assert_allclose(plan(world.model, world.task).solution.values, expected, atol=1e-6)
