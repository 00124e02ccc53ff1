"""From positions to moves: worked cases, properties that must hold for any walk, and every refusal."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from sidestep.errors import InputError
from sidestep.io.gridding import grid_walks
from sidestep.io.maps import read_map
from sidestep.io.walks import read_walks, walks_of_table
from sidestep.tabular.grid import Cell, Connectivity, Grid

DATA = Path(__file__).parents[3] / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="needs the data folder beside the checkout")
SIZE = 7
MIRRORED_ACTION = np.array([0, 1, 3, 2, 5, 4, 7, 6])
NAN = float("nan")


def walk_along(*lines, goals=None, failed=None):
    """Walks along lists of positions (metres); `failed`: where a move at (walk, position) did not lead."""
    lengths = [len(line) for line in lines]
    positions = np.concatenate([np.asarray(line, dtype=float) for line in lines])
    columns = {
        "walk": np.repeat(np.arange(len(lines)), lengths),
        "step": np.concatenate([np.arange(length) for length in lengths]),
        "x": positions[:, 0],
        "y": positions[:, 1],
    }
    if goals is not None:
        columns |= {
            "goal_x": np.repeat([x for x, _ in goals], lengths),
            "goal_y": np.repeat([y for _, y in goals], lengths),
        }
    if failed:
        targets = np.full((len(positions), 2), NAN)
        for (walk, position), target in failed.items():
            targets[sum(lengths[:walk]) + position] = target
        columns |= {"failed_x": targets[:, 0], "failed_y": targets[:, 1]}
    return walks_of_table(pa.table(columns), source="walks.csv")


def grid_of(*drawing, connectivity: Connectivity = 4):
    """A grid drawn with # for occupied, . for free and ? for unknown cells, the top row first."""
    cells = {"#": Cell.OCCUPIED, ".": Cell.FREE, "?": Cell.UNKNOWN}
    return Grid(
        np.array([[cells[sign] for sign in row] for row in drawing], dtype=np.int64),
        connectivity=connectivity,
    )


def cells_along(grid, *line, **options):
    """The cells of one walk, as (column, row from the bottom)."""
    moves = grid_walks(walk_along(line, **options), grid)
    np.testing.assert_array_equal(moves.next_states[:-1], moves.states[1:])
    centres = grid.to_cell_units(grid.centres(np.append(moves.states[:1], moves.next_states)))
    return [tuple(cell) for cell in np.floor(centres).astype(int).tolist()]


blank = Grid.unknown(SIZE, SIZE)
blank8 = Grid.unknown(SIZE, SIZE, connectivity=8)


def test_every_crossed_cell_in_turn():
    assert cells_along(blank, (0.5, 0.5), (3.5, 0.5)) == [(0, 0), (1, 0), (2, 0), (3, 0)]
    assert cells_along(blank, (0.5, 0.25), (2.5, 1.5)) == [(0, 0), (1, 0), (1, 1), (2, 1)]
    assert cells_along(blank, (2.5, 3.5), (2.5, 1.5)) == [(2, 3), (2, 2), (2, 1)]


def test_states_actions_and_goals():
    moves = grid_walks(walk_along([(0.5, 0.5), (1.5, 0.5), (1.5, 1.5)], [(1.5, 1.5), (0.5, 1.5)]), Grid.unknown(2, 2))
    assert moves.states.tolist() == [2, 3, 1]
    assert moves.next_states.tolist() == [3, 1, 0]
    assert moves.actions.tolist() == [3, 0, 2]
    assert moves.walk.tolist() == [0, 0, 1]
    assert moves.rows.tolist() == [2, 3, 5]
    assert moves.goals.tolist() == [1, 0]
    assert moves.source == "walks.csv"


def test_rows_name_where_a_move_ends():
    moves = grid_walks(walk_along([(0.5, 0.5), (0.6, 0.5), (2.5, 0.5), (2.6, 0.5), (3.5, 0.5)]), blank)
    assert moves.rows.tolist() == [3, 3, 5]
    assert grid_walks(walk_along([(0.5, 0.5), (0.6, 0.6), (1.5, 1.5)]), blank).rows.tolist() == [3, 3]


def test_dwelling_is_dropped():
    assert cells_along(blank, (0.5, 0.5), (0.5, 0.5), (0.7, 0.6), (0.2, 0.9), (1.5, 0.5), (1.5, 0.5)) == [
        (0, 0),
        (1, 0),
    ]


@pytest.mark.parametrize("grid", [blank, blank8])
def test_touching_a_border_is_not_entering(grid):
    assert cells_along(grid, (0.5, 0.5), (1.0, 0.5), (0.5, 1.0), (0.5, 1.5)) == [(0, 0), (0, 1)]
    assert cells_along(grid, (1.0, 1.0), (0.5, 0.5), (0.5, 1.5)) == [(0, 0), (0, 1)]


def test_through_a_corner_with_four_neighbours_goes_sideways_first():
    assert cells_along(blank, (0.5, 0.5), (1.5, 1.5)) == [(0, 0), (1, 0), (1, 1)]
    assert cells_along(blank, (1.5, 1.5), (0.5, 0.5)) == [(1, 1), (0, 1), (0, 0)]
    assert cells_along(blank, (0.5, 1.5), (1.0, 1.0), (1.5, 0.5)) == [(0, 1), (1, 1), (1, 0)]


@pytest.mark.parametrize("connectivity", [4, 8])
def test_through_a_corner_goes_around_a_known_obstacle(connectivity):
    beside = grid_of("??", "?#", connectivity=connectivity)
    assert cells_along(beside, (0.5, 0.5), (1.5, 1.5)) == [(0, 0), (0, 1), (1, 1)]
    above = grid_of("#?", "??", connectivity=connectivity)
    assert cells_along(above, (0.5, 0.5), (1.5, 1.5)) == [(0, 0), (1, 0), (1, 1)]


@pytest.mark.parametrize("connectivity", [4, 8])
def test_squeezing_between_two_known_obstacles_is_refused(connectivity):
    grid = grid_of("#?", "?#", connectivity=connectivity)
    with pytest.raises(InputError, match=r"walks\.csv, row 2, field 'x': .*occupied"):
        grid_walks(walk_along([(0.5, 0.5), (1.5, 1.5)]), grid)


def test_through_a_corner_with_eight_neighbours_is_a_diagonal():
    assert cells_along(blank8, (0.5, 0.5), (2.5, 2.5)) == [(0, 0), (1, 1), (2, 2)]
    assert cells_along(blank8, (0.5, 2.5), (1.0, 2.0), (2.5, 0.5)) == [(0, 2), (1, 1), (2, 0)]
    assert grid_walks(walk_along([(0.5, 0.5), (1.5, 1.5)]), blank8).actions.tolist() == [5]


@pytest.mark.parametrize("offset", [0.001, 0.1, 0.3, 0.499999999, 0.5])
def test_a_line_at_45_degrees_is_no_staircase(offset):
    cells = cells_along(blank8, (0.5, 0.5 - offset), (5.5, 5.5 - offset))
    assert len(cells) in (6, 7)
    diagonals = [abs(x - u) == abs(y - v) for (x, y), (u, v) in pairwise(cells)]
    assert sum(diagonals) >= 5 - (offset >= 0.499)


def test_the_clipped_cell_is_kept_where_the_diagonal_would_cut_a_known_corner():
    line = (0.5, 0.4), (1.6, 1.5)
    assert cells_along(grid_of("??", "??", connectivity=8), *line) == [(0, 0), (1, 1)]
    assert cells_along(grid_of("#?", "??", connectivity=8), *line) == [(0, 0), (1, 0), (1, 1)]


def test_only_short_clips_are_cut():
    short, long = 0.707 / 2, 0.708 / 2
    for reach, expected in ((short, [(0, 1), (1, 0)]), (long, [(0, 1), (1, 1), (1, 0)])):
        # In through the left side of cell (1, 1), 2 · reach of path inside it, out through its bottom.
        line = (0.5, 1.0 + reach), (1.0 + reach, 1.0 + reach), (1.0 + reach, 0.5)
        assert cells_along(blank8, *line) == expected


def test_the_length_of_a_clip_adds_up_over_pieces():
    line = (0.5, 1.3), (1.1, 1.3), (1.1, 1.6), (1.3, 1.6), (1.3, 0.5)
    assert cells_along(blank8, *line) == [(0, 1), (1, 1), (1, 0)]


def test_cuts_do_not_overlap():
    # Every cell is crossed along half a diagonal: of the four between the ends, the first and third go.
    line = (0.5, 0.0), (3.5, 3.0)
    assert cells_along(blank, *line) == [(0, 0), (1, 0), (1, 1), (2, 1), (2, 2), (3, 2)]
    assert cells_along(blank8, *line) == [(0, 0), (1, 1), (2, 2), (3, 2)]


def test_in_and_out_by_the_same_side_is_no_clip():
    assert cells_along(blank8, (0.5, 0.5), (1.1, 0.5), (0.5, 0.6)) == [(0, 0), (1, 0), (0, 0)]


def test_straight_through_a_cell_is_no_clip_even_at_the_rim():
    grid = Grid.unknown(1, 3, connectivity=8)
    assert cells_along(grid, (0.5, 0.5), (2.5, 0.5)) == [(0, 0), (1, 0), (2, 0)]


def test_along_a_border_keeps_off_known_obstacles():
    right_is_wall = grid_of("?#?", "?#?", "?#?")
    assert cells_along(right_is_wall, (1.0, 0.5), (1.0, 2.5)) == [(0, 0), (0, 1), (0, 2)]
    assert cells_along(blank, (1.0, 0.5), (1.0, 2.5)) == [(1, 0), (1, 1), (1, 2)]
    wall_above = grid_of("?#?", "???", "???")
    assert cells_along(wall_above, (0.5, 2.0), (2.5, 2.0)) == [(0, 2), (0, 1), (1, 1), (2, 1), (2, 2)]


def test_the_rim_of_the_map_is_inside():
    assert cells_along(Grid.unknown(2, 2), (0.0, 2.0), (2.0, 2.0), (2.0, 0.0)) == [(0, 1), (1, 1), (1, 0)]


def test_resolution_origin_and_yaw():
    turned = Grid(np.full((2, 3), -1), resolution=0.1, origin=(5.0, -3.0, np.pi / 2))
    # The map's columns run along y, its rows (from the bottom) along −x.
    assert cells_along(turned, (4.95, -2.95), (4.95, -2.75), (4.85, -2.75)) == [
        (0, 0),
        (1, 0),
        (2, 0),
        (2, 1),
    ]


@pytest.mark.parametrize("grid", [blank, blank8])
def test_failed_moves_stay(grid):
    line = [(0.5, 0.5), (0.5, 0.5), (1.5, 0.5), (1.5, 0.5), (1.5, 0.5), (2.5, 0.5)]
    moves = grid_walks(walk_along(line, failed={(0, 1): (0.5, -0.5), (0, 3): (1.5, 1.5), (0, 4): (2.5, 0.5)}), grid)
    first, second, third = 42, 43, 44
    assert moves.states.tolist() == [first, first, second, second, second]
    assert moves.next_states.tolist() == [first, second, second, second, third]
    assert moves.actions.tolist() == [1, 3, 0, 3, 3]
    assert moves.rows.tolist() == [2, 3, 4, 5, 6]


def test_a_failed_diagonal_move():
    moves = grid_walks(walk_along([(0.5, 0.5), (0.5, 0.5)], failed={(0, 1): (1.5, 1.5)}), blank8)
    assert (moves.actions.tolist(), moves.next_states.tolist()) == ([5], [42])


def test_a_failed_move_in_the_first_row_and_on_a_border():
    line = [(1.0, 0.5), (0.5, 0.5), (0.5, 1.5)]
    moves = grid_walks(walk_along(line, failed={(0, 0): (1.5, 0.5)}), blank)
    assert (moves.states.tolist(), moves.next_states.tolist()) == ([42, 42], [42, 35])


def test_a_clipped_cell_where_a_move_failed_is_kept():
    line = [(0.5, 0.4), (1.05, 0.95), (1.6, 1.5)]
    assert cells_along(blank8, *line) == [(0, 0), (1, 1)]
    assert cells_along(blank8, *line, failed={(0, 1): (2.5, 0.5)}) == [(0, 0), (1, 0), (1, 0), (1, 1)]


@pytest.mark.parametrize("target", [(0.6, 0.5), (2.5, 0.5), (1.5, 1.5), (-1.5, 0.5)])
def test_a_failed_move_to_no_adjacent_cell_is_refused(target):
    walks = walk_along([(0.5, 0.5), (1.5, 0.5), (0.5, 0.5)], failed={(0, 2): target})
    with pytest.raises(
        InputError, match=r"walks\.csv, row 3, field 'failed_x': expected a failed move to one of the 4"
    ):
        grid_walks(walks, blank)


def test_goals_on_a_border_count_where_the_walk_ends():
    walks = walk_along([(0.5, 0.5), (1.5, 0.5), (2.0, 0.5)], [(3.5, 0.5), (2.5, 0.5), (2.0, 0.5)])
    assert grid_walks(walks, blank).goals.tolist() == [43, 44]


def test_goals_of_their_own():
    walks = walk_along([(0.5, 0.5), (1.5, 0.5)], goals=[(6.5, 6.5)])
    assert grid_walks(walks, blank).goals.tolist() == [6]


@pytest.mark.parametrize(
    ("position", "field"), [((-0.1, 0.5), "x"), ((7.1, 0.5), "x"), ((0.5, -0.1), "y"), ((0.5, 7.1), "y")]
)
def test_positions_outside_the_map(position, field):
    with pytest.raises(InputError, match=rf"walks\.csv, row 4, field '{field}': expected a position on the map"):
        grid_walks(walk_along([(0.5, 0.5), (1.5, 0.5)], [(0.5, 0.5), position]), blank)
    with pytest.raises(InputError, match=rf"walks\.csv, row 3, field 'goal_{field}': expected a position on the map"):
        grid_walks(walk_along(*[[(0.5, 0.5), (1.5, 0.5)]] * 2, goals=[(NAN, NAN), position]), blank)


@pytest.mark.parametrize("connectivity", [4, 8])
def test_walks_through_known_obstacles(connectivity):
    grid = grid_of("???", "?#?", "???", connectivity=connectivity)
    walks = walk_along([(0.5, 0.5), (2.5, 0.5)], [(0.5, 1.5), (0.7, 1.5), (2.5, 1.5)])
    with pytest.raises(InputError, match=r"walks\.csv, row 5, field 'x': .*\(image row 1, column 1, from 0\)"):
        grid_walks(walks, grid)


def test_a_clip_of_a_known_obstacle_is_refused():
    with pytest.raises(InputError, match=r"walks\.csv, row 2, field 'x': .*occupied"):
        grid_walks(walk_along([(0.5, 0.4), (1.6, 1.5)]), grid_of("??", "?#", connectivity=8))


def test_goals_in_known_obstacles():
    walks = walk_along([(0.5, 0.5), (1.5, 0.5)], [(0.5, 0.5), (1.5, 0.5)], goals=[(NAN, NAN), (2.5, 0.5)])
    with pytest.raises(InputError, match=r"walks\.csv, row 3, field 'goal_x': the goal \(2\.5, 0\.5\) lies in a cell"):
        grid_walks(walks, grid_of("??#"))


def test_walks_of_one_cell():
    walks = walk_along([(0.5, 0.5), (1.5, 0.5)], [(0.2, 0.5), (0.7, 0.5), (1.0, 0.5)])
    with pytest.raises(InputError, match=r"walks\.csv, row 3, field 'walk': .* walk 1 never leaves its cell"):
        grid_walks(walks, blank)


def test_no_walks_at_all():
    walks = walk_along([(0.5, 0.5), (1.5, 0.5)]).select(np.array([False]))
    with pytest.raises(InputError, match=r"walks\.csv: expected at least one walk"):
        grid_walks(walks, blank)


def test_rows_are_those_of_the_file_even_when_walks_interleave():
    table = pa.table(
        {
            "walk": ["a", "b", "a", "b"],
            "step": [0, 0, 1, 1],
            "x": [0.5, 0.5, 1.5, 1.5],
            "y": [0.5, 0.5, 0.5, 9.0],
        }
    )
    with pytest.raises(InputError, match="row 4, field 'y'"):
        grid_walks(walks_of_table(table), blank)


def interleaved(**columns):
    """Two walks whose rows alternate, so that the later walk holds the earlier row."""
    return walks_of_table(pa.table({"walk": ["a", "b", "b", "a"], "step": [0, 0, 1, 1], **columns}))


def test_the_first_bad_row_of_the_file_is_named():
    outside = interleaved(x=[0.5, 0.5, 9.0, 9.0], y=[0.5] * 4)
    with pytest.raises(InputError, match="row 3, field 'x': expected a position on the map"):
        grid_walks(outside, blank)
    blocked = interleaved(x=[0.5, 0.5, 1.5, 1.5], y=[0.5] * 4)
    with pytest.raises(InputError, match=r"row 3, field 'x': .*occupied"):
        grid_walks(blocked, grid_of("?#"))


anywhere = st.integers(0, 2**32 - 1).map(lambda seed: tuple(np.random.default_rng(seed).uniform(0, SIZE, 2).tolist()))
centre = st.tuples(*[st.integers(0, SIZE - 1).map(lambda index: index + 0.5)] * 2)
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


@given(st.lists(lines(anywhere | centre | lattice), min_size=1, max_size=3), connectivities)
def test_moves_are_what_their_actions_say(many, connectivity):
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
def test_positions_on_borders_and_corners_keep_the_rules(line, obstacles, connectivity):
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


@given(st.lists(lines(anywhere | centre), min_size=2, max_size=3), connectivities)
def test_walks_do_not_influence_each_other(many, connectivity):
    together = grid_walks(walk_along(*many), Grid.unknown(SIZE, SIZE, connectivity=connectivity))
    apart = [moves_along(line, connectivity) for line in many]
    for field in ("states", "actions", "next_states", "goals"):
        np.testing.assert_array_equal(getattr(together, field), np.concatenate([getattr(one, field) for one in apart]))


@given(lines(anywhere | centre), connectivities)
def test_mirrored_walks_give_mirrored_moves(line, connectivity):
    moves, mirrored = (moves_along(one, connectivity) for one in (line, [(SIZE - x, y) for x, y in line]))
    row, column = np.divmod(moves.states, SIZE)
    np.testing.assert_array_equal(mirrored.states, row * SIZE + SIZE - 1 - column)
    np.testing.assert_array_equal(mirrored.actions, MIRRORED_ACTION[moves.actions])


@given(lines(anywhere | centre | lattice), st.lists(st.floats(0, 1), max_size=4), connectivities)
def test_more_positions_on_the_same_line_change_nothing(line, fractions, connectivity):
    refined = [line[0]]
    for start, end in pairwise(np.asarray(line)):
        refined += [tuple(start + fraction * (end - start)) for fraction in sorted(fractions)] + [tuple(end)]
    moves, more = moves_along(line, connectivity), moves_along(refined, connectivity)
    np.testing.assert_array_equal(more.states, moves.states)
    np.testing.assert_array_equal(more.next_states, moves.next_states)


@given(lines(anywhere))
def test_a_walk_back_visits_the_same_cells(line):
    there, back = moves_along(line, 4), moves_along(line[::-1], 4)
    np.testing.assert_array_equal(back.states[::-1], there.next_states)


@settings(deadline=None)
@given(lines(anywhere))
def test_the_cells_are_those_of_a_dense_sampling(line):
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


@given(lines(anywhere | centre))
def test_eight_neighbours_only_leave_cells_out(line):
    full, fewer = moves_along(line, 4), moves_along(line, 8)
    remaining = iter(np.append(full.states[0], full.next_states).tolist())
    assert all(state in remaining for state in fewer.next_states.tolist())
    assert len(full.states) <= 2 * len(fewer.states)


def test_a_million_positions_take_seconds():
    noise = np.random.default_rng(0).normal(0, 0.3, (1_000_000, 2))
    line = np.abs((np.cumsum(noise, axis=0) + 500) % 2000 - 1000)
    moves = grid_walks(walk_along(line), Grid.unknown(1000, 1000, connectivity=8))
    assert len(moves.states) > 100_000


@needs_data
@pytest.mark.parametrize("world", ["blank", "truth"])
def test_people_in_the_tartarus_maze_move_cell_by_cell(world):
    folder = DATA / "tartarus" / "maze_01"
    walks, grid = read_walks(folder / "humans.csv"), read_map(folder / f"{world}.yaml")
    moves = grid_walks(walks, grid)
    assert len(moves.states) == len(walks.positions) - len(walks)
    assert set(moves.goals.tolist()) == {3 * 10 + 3}
    np.testing.assert_array_equal(moves.next_states, np.delete(grid.states(walks.positions), walks.offsets[:-1]))


@needs_data
def test_a_rat_over_a_hole_is_refused():
    folder = DATA / "tartarus" / "maze_12"
    with pytest.raises(InputError, match=r"rats\.csv, row 80, field 'x': .*\(image row 7, column 3, from 0\)"):
        grid_walks(read_walks(folder / "rats.csv"), read_map(folder / "truth.yaml"))


@needs_data
@pytest.mark.parametrize("town", "ABCD")
def test_drives_among_buildings(town):
    folder = DATA / "magellan" / f"town_{town}"
    walks = read_walks(folder / "drives.csv")
    four, eight = (grid_walks(walks, read_map(folder / "truth.yaml", connectivity)) for connectivity in (4, 8))
    assert len(eight.states) < len(four.states) <= 2 * len(eight.states)
    assert walks.metadata["subject"][0].as_py() == "003"
