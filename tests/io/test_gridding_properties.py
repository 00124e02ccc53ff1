"""From positions to moves: properties that must hold for any walk."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from helpers.drawn import SIZE, walk_along
from sidestep.errors import InputError
from sidestep.io.gridding import grid_walks
from sidestep.tabular.grid import Cell, Grid

MIRRORED_ACTION = np.array([0, 1, 3, 2, 5, 4, 7, 6])

anywhere = st.integers(0, 2**32 - 1).map(lambda seed: tuple(np.random.default_rng(seed).uniform(0, SIZE, 2).tolist()))
center = st.tuples(*[st.integers(0, SIZE - 1).map(lambda index: index + 0.5)] * 2)
corner = st.tuples(*[st.integers(0, SIZE).map(float)] * 2)
lattice = st.tuples(*[st.integers(0, 4 * SIZE).map(lambda index: index / 4)] * 2)
connectivities = st.sampled_from([4, 8])


def lines(point):
    return st.lists(point, min_size=2, max_size=6).filter(leaves_its_cell)


def leaves_its_cell(line):
    """Whether some position lies clearly in another cell than the first, so that there is a move."""
    cells = np.floor(np.asarray(line))
    return bool((cells != cells[0]).any()) and not (np.asarray(line) % 1 == 0).any()


def moves_along(line, connectivity):
    return grid_walks(walk_along(line), Grid.unknown(SIZE, SIZE, connectivity=connectivity))


@given(st.lists(lines(anywhere | center | lattice), min_size=1, max_size=3), connectivities)
def test_grid_walks_moves_follow_their_actions(many, connectivity):
    grid = Grid.unknown(SIZE, SIZE, connectivity=connectivity)
    moves = grid_walks(walk_along(*many), grid)
    cell, following = (np.stack(np.divmod(states, SIZE), axis=1) for states in (moves.states, moves.next_states))
    np.testing.assert_array_equal(following - cell, grid.steps[moves.actions])
    same = moves.walk[1:] == moves.walk[:-1]
    np.testing.assert_array_equal(moves.next_states[:-1][same], moves.states[1:][same])
    ends = np.append(np.flatnonzero(~same), len(moves.walk) - 1)
    np.testing.assert_array_equal(moves.next_states[ends], moves.goals)
    first = np.array([line[0] for line in many])
    np.testing.assert_array_equal(moves.states[np.append(0, ends[:-1] + 1)], grid.states(first))


@given(
    st.lists(lattice | corner, min_size=2, max_size=8),
    st.sets(st.integers(0, SIZE**2 - 1), max_size=12),
    connectivities,
)
def test_grid_walks_on_borders_and_corners_follows_the_rules(line, obstacles, connectivity):
    known = np.full((SIZE, SIZE), int(Cell.UNKNOWN))
    known.flat[list(obstacles)] = Cell.OCCUPIED
    grid = Grid(known, connectivity=connectivity)
    try:
        moves = grid_walks(walk_along(line), grid)
    except InputError:
        assume(False)
        return
    assert not obstacles & {*moves.states.tolist(), *moves.next_states.tolist(), *moves.goals.tolist()}
    assert moves.next_states[-1] == moves.goals[0]
    np.testing.assert_array_equal(moves.next_states[:-1], moves.states[1:])
    row, column = np.divmod(moves.states, SIZE)
    steps = grid.steps[moves.actions]
    np.testing.assert_array_equal(
        np.stack(np.divmod(moves.next_states, SIZE), axis=1), np.stack([row, column], 1) + steps
    )
    assert not (known[row + steps[:, 0], column] == Cell.OCCUPIED).any(), "a diagonal cuts a known corner"
    assert not (known[row, column + steps[:, 1]] == Cell.OCCUPIED).any(), "a diagonal cuts a known corner"


@pytest.mark.slow
@given(st.lists(lines(anywhere | center), min_size=2, max_size=3), connectivities)
def test_grid_walks_treats_walks_independently(many, connectivity):
    together = grid_walks(walk_along(*many), Grid.unknown(SIZE, SIZE, connectivity=connectivity))
    split_by_person = [moves_along(line, connectivity) for line in many]
    for field in ("states", "actions", "next_states", "goals"):
        np.testing.assert_array_equal(
            getattr(together, field), np.concatenate([getattr(one, field) for one in split_by_person])
        )


@given(lines(anywhere | center), connectivities)
def test_grid_walks_of_mirrored_walks_are_mirrored(line, connectivity):
    moves, mirrored = (moves_along(one, connectivity) for one in (line, [(SIZE - x, y) for x, y in line]))
    row, column = np.divmod(moves.states, SIZE)
    np.testing.assert_array_equal(mirrored.states, row * SIZE + SIZE - 1 - column)
    np.testing.assert_array_equal(mirrored.actions, MIRRORED_ACTION[moves.actions])


@given(lines(anywhere | center | lattice), st.lists(st.floats(0, 1), max_size=4), connectivities)
def test_grid_walks_ignores_more_positions_on_a_line(line, fractions, connectivity):
    refined = [line[0]]
    for start, end in pairwise(np.asarray(line)):
        refined += [tuple(start + fraction * (end - start)) for fraction in sorted(fractions)] + [tuple(end)]
    moves, more = moves_along(line, connectivity), moves_along(refined, connectivity)
    np.testing.assert_array_equal(more.states, moves.states)
    np.testing.assert_array_equal(more.next_states, moves.next_states)


@given(lines(anywhere))
def test_grid_walks_backward_visits_the_same_cells(line):
    there, back = moves_along(line, 4), moves_along(line[::-1], 4)
    np.testing.assert_array_equal(back.states[::-1], there.next_states)


@pytest.mark.slow
@settings(deadline=None)
@given(lines(anywhere))
def test_grid_walks_agrees_with_dense_sampling(line):
    grid, spacing = Grid.unknown(SIZE, SIZE), 2**-9
    fractions = np.linspace(0, 1, int(2 * SIZE / spacing))[:, None]
    samples = np.concatenate([start + fractions * (end - start) for start, end in pairwise(np.asarray(line))])
    sampled = grid.states(samples)
    runs = np.flatnonzero(np.diff(sampled, prepend=-1))
    moves = grid_walks(walk_along(line), grid)
    visited = np.append(moves.states[0], moves.next_states).tolist()
    # The cells of the samples are visited in their order; only clips too small to sample may come between.
    remaining = iter(visited)
    assert all(state in remaining for state in sampled[runs].tolist())
    rows, columns = np.divmod(np.array(visited), SIZE)
    corner = np.stack([columns, SIZE - 1 - rows], axis=1)
    distance = np.maximum(np.abs(samples[:, None] - corner - 0.5) - 0.5, 0).max(axis=2).min(axis=0)
    assert distance.max() <= spacing


@given(lines(anywhere | center))
def test_grid_walks_8_connected_only_leaves_out_cells(line):
    full, fewer = moves_along(line, 4), moves_along(line, 8)
    remaining = iter(np.append(full.states[0], full.next_states).tolist())
    assert all(state in remaining for state in fewer.next_states.tolist())
    assert len(full.states) <= 2 * len(fewer.states)


@pytest.mark.slow
def test_grid_walks_of_a_million_positions_takes_seconds():
    noise = np.random.default_rng(0).normal(0, 0.3, (1_000_000, 2))
    line = np.abs((np.cumsum(noise, axis=0) + 500) % 2000 - 1000)
    moves = grid_walks(walk_along(line), Grid.unknown(1000, 1000, connectivity=8))
    assert len(moves.states) > 100_000
