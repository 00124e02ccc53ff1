"""From positions to moves: worked cases, every refusal, and walks that people took."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from helpers.drawn import NAN, SIZE, grid_of, walk_along
from sidestep.errors import InputError
from sidestep.io.gridding import grid_walks
from sidestep.io.maps import read_map
from sidestep.io.walks import read_walks, walks_from_table
from sidestep.tabular.grid import Grid

DATA = Path(__file__).parents[3] / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="needs the data folder beside the checkout")


def cells_along(grid, *line, **options):
    """The cells of one walk, as (column, row from the bottom)."""
    moves = grid_walks(walk_along(line, **options), grid)
    np.testing.assert_array_equal(moves.next_states[:-1], moves.states[1:])
    centers = grid.to_cell_units(grid.centers(np.append(moves.states[:1], moves.next_states)))
    return [tuple(cell) for cell in np.floor(centers).astype(int).tolist()]


blank = Grid.unknown(SIZE, SIZE)
blank8 = Grid.unknown(SIZE, SIZE, connectivity=8)


def test_grid_walks_visits_every_crossed_cell_in_order():
    assert cells_along(blank, (0.5, 0.5), (3.5, 0.5)) == [(0, 0), (1, 0), (2, 0), (3, 0)]
    assert cells_along(blank, (0.5, 0.25), (2.5, 1.5)) == [(0, 0), (1, 0), (1, 1), (2, 1)]
    assert cells_along(blank, (2.5, 3.5), (2.5, 1.5)) == [(2, 3), (2, 2), (2, 1)]


def test_grid_walks_returns_states_actions_and_goals():
    moves = grid_walks(walk_along([(0.5, 0.5), (1.5, 0.5), (1.5, 1.5)], [(1.5, 1.5), (0.5, 1.5)]), Grid.unknown(2, 2))
    assert moves.states.tolist() == [2, 3, 1]
    assert moves.next_states.tolist() == [3, 1, 0]
    assert moves.actions.tolist() == [3, 0, 2]
    assert moves.walk.tolist() == [0, 0, 1]
    assert moves.rows.tolist() == [2, 3, 5]
    assert moves.goals.tolist() == [1, 0]
    assert moves.source == "walks.csv"


def test_grid_walks_rows_are_those_where_moves_end():
    moves = grid_walks(walk_along([(0.5, 0.5), (0.6, 0.5), (2.5, 0.5), (2.6, 0.5), (3.5, 0.5)]), blank)
    assert moves.rows.tolist() == [3, 3, 5]
    assert grid_walks(walk_along([(0.5, 0.5), (0.6, 0.6), (1.5, 1.5)]), blank).rows.tolist() == [3, 3]


def test_grid_walks_drops_dwelling():
    assert cells_along(blank, (0.5, 0.5), (0.5, 0.5), (0.7, 0.6), (0.2, 0.9), (1.5, 0.5), (1.5, 0.5)) == [
        (0, 0),
        (1, 0),
    ]


@pytest.mark.parametrize("grid", [blank, blank8])
def test_grid_walks_touching_a_border_enters_no_cell(grid):
    assert cells_along(grid, (0.5, 0.5), (1.0, 0.5), (0.5, 1.0), (0.5, 1.5)) == [(0, 0), (0, 1)]
    assert cells_along(grid, (1.0, 1.0), (0.5, 0.5), (0.5, 1.5)) == [(0, 0), (0, 1)]


def test_grid_walks_4_connected_through_a_corner_goes_sideways_first():
    assert cells_along(blank, (0.5, 0.5), (1.5, 1.5)) == [(0, 0), (1, 0), (1, 1)]
    assert cells_along(blank, (1.5, 1.5), (0.5, 0.5)) == [(1, 1), (0, 1), (0, 0)]
    assert cells_along(blank, (0.5, 1.5), (1.0, 1.0), (1.5, 0.5)) == [(0, 1), (1, 1), (1, 0)]


@pytest.mark.parametrize("connectivity", [4, 8])
def test_grid_walks_through_a_corner_avoids_a_known_obstacle(connectivity):
    beside = grid_of("??", "?#", connectivity=connectivity)
    assert cells_along(beside, (0.5, 0.5), (1.5, 1.5)) == [(0, 0), (0, 1), (1, 1)]
    above = grid_of("#?", "??", connectivity=connectivity)
    assert cells_along(above, (0.5, 0.5), (1.5, 1.5)) == [(0, 0), (1, 0), (1, 1)]


@pytest.mark.parametrize("connectivity", [4, 8])
def test_grid_walks_between_two_known_obstacles_raises(connectivity):
    grid = grid_of("#?", "?#", connectivity=connectivity)
    with pytest.raises(InputError, match=r"walks\.csv, row 2, field 'x': .*occupied"):
        grid_walks(walk_along([(0.5, 0.5), (1.5, 1.5)]), grid)


def test_grid_walks_8_connected_through_a_corner_is_diagonal():
    assert cells_along(blank8, (0.5, 0.5), (2.5, 2.5)) == [(0, 0), (1, 1), (2, 2)]
    assert cells_along(blank8, (0.5, 2.5), (1.0, 2.0), (2.5, 0.5)) == [(0, 2), (1, 1), (2, 0)]
    assert grid_walks(walk_along([(0.5, 0.5), (1.5, 1.5)]), blank8).actions.tolist() == [5]


@pytest.mark.parametrize("offset", [0.001, 0.1, 0.3, 0.499999999, 0.5])
def test_grid_walks_8_connected_at_45_degrees_is_no_staircase(offset):
    cells = cells_along(blank8, (0.5, 0.5 - offset), (5.5, 5.5 - offset))
    assert len(cells) in (6, 7)
    diagonals = [abs(x - u) == abs(y - v) for (x, y), (u, v) in pairwise(cells)]
    assert sum(diagonals) >= 5 - (offset >= 0.499)


def test_grid_walks_keeps_a_clipped_cell_beside_a_known_corner():
    line = (0.5, 0.4), (1.6, 1.5)
    assert cells_along(grid_of("??", "??", connectivity=8), *line) == [(0, 0), (1, 1)]
    assert cells_along(grid_of("#?", "??", connectivity=8), *line) == [(0, 0), (1, 0), (1, 1)]


def test_grid_walks_leaves_out_short_clips_only():
    short, long = 0.707 / 2, 0.708 / 2
    for reach, expected in ((short, [(0, 1), (1, 0)]), (long, [(0, 1), (1, 1), (1, 0)])):
        # In through the left side of cell (1, 1), 2 · reach of path inside it, out through its bottom.
        line = (0.5, 1.0 + reach), (1.0 + reach, 1.0 + reach), (1.0 + reach, 0.5)
        assert cells_along(blank8, *line) == expected


def test_grid_walks_adds_up_the_length_of_a_clip():
    line = (0.5, 1.3), (1.1, 1.3), (1.1, 1.6), (1.3, 1.6), (1.3, 0.5)
    assert cells_along(blank8, *line) == [(0, 1), (1, 1), (1, 0)]


def test_grid_walks_leaves_out_every_other_clipped_cell():
    # Every cell is crossed along half a diagonal: of the four between the ends, the first and third go.
    line = (0.5, 0.0), (3.5, 3.0)
    assert cells_along(blank, *line) == [(0, 0), (1, 0), (1, 1), (2, 1), (2, 2), (3, 2)]
    assert cells_along(blank8, *line) == [(0, 0), (1, 1), (2, 2), (3, 2)]


def test_grid_walks_in_and_out_by_one_side_is_no_clip():
    assert cells_along(blank8, (0.5, 0.5), (1.1, 0.5), (0.5, 0.6)) == [(0, 0), (1, 0), (0, 0)]


def test_grid_walks_straight_through_a_cell_is_no_clip():
    grid = Grid.unknown(1, 3, connectivity=8)
    assert cells_along(grid, (0.5, 0.5), (2.5, 0.5)) == [(0, 0), (1, 0), (2, 0)]


def test_grid_walks_along_a_border_avoids_known_obstacles():
    right_is_wall = grid_of("?#?", "?#?", "?#?")
    assert cells_along(right_is_wall, (1.0, 0.5), (1.0, 2.5)) == [(0, 0), (0, 1), (0, 2)]
    assert cells_along(blank, (1.0, 0.5), (1.0, 2.5)) == [(1, 0), (1, 1), (1, 2)]
    wall_above = grid_of("?#?", "???", "???")
    assert cells_along(wall_above, (0.5, 2.0), (2.5, 2.0)) == [(0, 2), (0, 1), (1, 1), (2, 1), (2, 2)]


def test_grid_walks_on_the_edge_of_the_map_is_inside():
    assert cells_along(Grid.unknown(2, 2), (0.0, 2.0), (2.0, 2.0), (2.0, 0.0)) == [(0, 1), (1, 1), (1, 0)]


def test_grid_walks_uses_resolution_origin_and_yaw():
    turned = Grid(np.full((2, 3), -1), resolution=0.1, origin=(5.0, -3.0, np.pi / 2))
    # The map's columns run along y, its rows (from the bottom) along −x.
    assert cells_along(turned, (4.95, -2.95), (4.95, -2.75), (4.85, -2.75)) == [(0, 0), (1, 0), (2, 0), (2, 1)]


@pytest.mark.parametrize("grid", [blank, blank8])
def test_grid_walks_failed_moves_stay(grid):
    line = [(0.5, 0.5), (0.5, 0.5), (1.5, 0.5), (1.5, 0.5), (1.5, 0.5), (2.5, 0.5)]
    moves = grid_walks(walk_along(line, failed={(0, 1): (0.5, -0.5), (0, 3): (1.5, 1.5), (0, 4): (2.5, 0.5)}), grid)
    first, second, third = 42, 43, 44
    assert moves.states.tolist() == [first, first, second, second, second]
    assert moves.next_states.tolist() == [first, second, second, second, third]
    assert moves.actions.tolist() == [1, 3, 0, 3, 3]
    assert moves.rows.tolist() == [2, 3, 4, 5, 6]


def test_grid_walks_failed_diagonal_move_stays():
    moves = grid_walks(walk_along([(0.5, 0.5), (0.5, 0.5)], failed={(0, 1): (1.5, 1.5)}), blank8)
    assert (moves.actions.tolist(), moves.next_states.tolist()) == ([5], [42])


def test_grid_walks_failed_move_in_the_first_row_or_on_a_border():
    line = [(1.0, 0.5), (0.5, 0.5), (0.5, 1.5)]
    moves = grid_walks(walk_along(line, failed={(0, 0): (1.5, 0.5)}), blank)
    assert (moves.states.tolist(), moves.next_states.tolist()) == ([42, 42], [42, 35])


def test_grid_walks_keeps_a_clipped_cell_of_a_failed_move():
    line = [(0.5, 0.4), (1.05, 0.95), (1.6, 1.5)]
    assert cells_along(blank8, *line) == [(0, 0), (1, 1)]
    assert cells_along(blank8, *line, failed={(0, 1): (2.5, 0.5)}) == [(0, 0), (1, 0), (1, 0), (1, 1)]


@pytest.mark.parametrize("target", [(0.6, 0.5), (2.5, 0.5), (1.5, 1.5), (-1.5, 0.5)])
def test_grid_walks_failed_move_to_no_adjacent_cell_raises(target):
    walks = walk_along([(0.5, 0.5), (1.5, 0.5), (0.5, 0.5)], failed={(0, 2): target})
    with pytest.raises(InputError, match=r"walks\.csv, row 3, field 'failed_x': expected a failed move to one of"):
        grid_walks(walks, blank)


def test_grid_walks_goal_on_a_border_is_where_the_walk_ends():
    walks = walk_along([(0.5, 0.5), (1.5, 0.5), (2.0, 0.5)], [(3.5, 0.5), (2.5, 0.5), (2.0, 0.5)])
    assert grid_walks(walks, blank).goals.tolist() == [43, 44]


@pytest.mark.parametrize(
    ("position", "field"), [((-0.1, 0.5), "x"), ((7.1, 0.5), "x"), ((0.5, -0.1), "y"), ((0.5, 7.1), "y")]
)
def test_grid_walks_outside_the_map_raises(position, field):
    with pytest.raises(InputError, match=rf"walks\.csv, row 4, field '{field}': expected a position on the map"):
        grid_walks(walk_along([(0.5, 0.5), (1.5, 0.5)], [(0.5, 0.5), position]), blank)
    with pytest.raises(InputError, match=rf"walks\.csv, row 3, field 'goal_{field}': expected a position on the map"):
        grid_walks(walk_along(*[[(0.5, 0.5), (1.5, 0.5)]] * 2, goals=[(NAN, NAN), position]), blank)


@pytest.mark.parametrize("connectivity", [4, 8])
def test_grid_walks_through_known_obstacles_raises(connectivity):
    grid = grid_of("???", "?#?", "???", connectivity=connectivity)
    walks = walk_along([(0.5, 0.5), (2.5, 0.5)], [(0.5, 1.5), (0.7, 1.5), (2.5, 1.5)])
    with pytest.raises(InputError, match=r"walks\.csv, row 5, field 'x': .*\(image row 1, column 1, from 0\)"):
        grid_walks(walks, grid)


def test_grid_walks_clipping_a_known_obstacle_raises():
    with pytest.raises(InputError, match=r"walks\.csv, row 2, field 'x': .*occupied"):
        grid_walks(walk_along([(0.5, 0.4), (1.6, 1.5)]), grid_of("??", "?#", connectivity=8))


def test_grid_walks_goal_in_a_known_obstacle_raises():
    walks = walk_along([(0.5, 0.5), (1.5, 0.5)], [(0.5, 0.5), (1.5, 0.5)], goals=[(NAN, NAN), (2.5, 0.5)])
    with pytest.raises(InputError, match=r"walks\.csv, row 3, field 'goal_x': the goal \(2\.5, 0\.5\) lies in a cell"):
        grid_walks(walks, grid_of("??#"))


def test_grid_walks_within_one_cell_raises():
    walks = walk_along([(0.5, 0.5), (1.5, 0.5)], [(0.2, 0.5), (0.7, 0.5), (1.0, 0.5)])
    with pytest.raises(InputError, match=r"walks\.csv, row 3, field 'walk': .* walk 1 never leaves its cell"):
        grid_walks(walks, blank)


def test_grid_walks_without_walks_raises():
    walks = walk_along([(0.5, 0.5), (1.5, 0.5)]).select(np.array([False]))
    with pytest.raises(InputError, match=r"walks\.csv: expected at least one walk"):
        grid_walks(walks, blank)


def interleaved(**columns):
    """Two walks whose rows alternate, so that the later walk holds the earlier row."""
    return walks_from_table(pa.table({"walk": ["a", "b", "b", "a"], "step": [0, 0, 1, 1], **columns}))


def test_grid_walks_names_the_first_bad_row():
    outside = interleaved(x=[0.5, 0.5, 9.0, 9.0], y=[0.5] * 4)
    with pytest.raises(InputError, match="row 3, field 'x': expected a position on the map"):
        grid_walks(outside, blank)
    blocked = interleaved(x=[0.5, 0.5, 1.5, 1.5], y=[0.5] * 4)
    with pytest.raises(InputError, match=r"row 3, field 'x': .*occupied"):
        grid_walks(blocked, grid_of("?#"))


@needs_data
@pytest.mark.parametrize("world", ["blank", "truth"])
def test_grid_walks_of_people_in_the_tartarus_maze_moves_cell_by_cell(world):
    folder = DATA / "tartarus" / "maze_01"
    walks, grid = read_walks(folder / "humans.csv"), read_map(folder / f"{world}.yaml")
    moves = grid_walks(walks, grid)
    assert len(moves.states) == len(walks.positions) - len(walks)
    assert set(moves.goals.tolist()) == {3 * 10 + 3}
    np.testing.assert_array_equal(moves.next_states, np.delete(grid.states(walks.positions), walks.offsets[:-1]))


@needs_data
def test_grid_walks_of_a_rat_over_a_hole_raises():
    folder = DATA / "tartarus" / "maze_12"
    with pytest.raises(InputError, match=r"rats\.csv, row 80, field 'x': .*\(image row 7, column 3, from 0\)"):
        grid_walks(read_walks(folder / "rats.csv"), read_map(folder / "truth.yaml"))


@needs_data
@pytest.mark.parametrize("town", "ABCD")
def test_grid_walks_of_drives_among_buildings(town):
    folder = DATA / "magellan" / f"town_{town}"
    walks = read_walks(folder / "drives.csv")
    four, eight = (grid_walks(walks, read_map(folder / "truth.yaml", connectivity)) for connectivity in (4, 8))
    assert len(eight.states) < len(four.states) <= 2 * len(eight.states)
    assert walks.metadata["subject"][0].as_py() == "003"
