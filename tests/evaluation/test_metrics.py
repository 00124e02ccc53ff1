"""Scores of learned maps and planned paths: worked cases, and brute force that really opens each obstacle."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse.csgraph import dijkstra

from sidestep.errors import InputError
from sidestep.evaluation.metrics import relevant_obstacles, score_map, score_paths, visit_ranking
from sidestep.tabular.graph import walkable_graph
from sidestep.tabular.grid import Cell, Connectivity, Grid

ROOT_TWO = 2**0.5


def grid_of(*drawing, connectivity: Connectivity = 4):
    """A grid drawn with # for occupied, . for free and ? for unknown cells, the top row first."""
    cells = {"#": Cell.OCCUPIED, ".": Cell.FREE, "?": Cell.UNKNOWN}
    known = np.array([[cells[sign] for sign in row] for row in drawing], dtype=np.int64)
    return Grid(known, connectivity=connectivity)


def array(*states):
    return np.array(states, dtype=np.int64)


# the walkable graph


def test_the_graph_of_a_corner_4_connected():
    graph = walkable_graph(grid_of("..", ".#")).toarray()
    np.testing.assert_array_equal(graph, [[0, 1, 1, 0], [1, 0, 0, 0], [1, 0, 0, 0], [0, 0, 0, 0]])


def test_diagonals_are_longer_and_do_not_cut_corners():
    open_square = walkable_graph(grid_of("..", "..", connectivity=8)).toarray()
    assert open_square[0, 3] == open_square[2, 1] == pytest.approx(ROOT_TWO)
    corner = walkable_graph(grid_of("..", ".#", connectivity=8)).toarray()
    assert corner[1, 2] == corner[2, 1] == 0


def test_unknown_cells_are_not_walkable():
    assert walkable_graph(grid_of(".?.")).nnz == 0


# which obstacles matter


@pytest.mark.parametrize(
    ("drawing", "connectivity", "visited", "goal", "expected"),
    [
        ([".#.", "..."], 4, 0, 2, [1]),  # 4 moves round it, 2 through it
        (["...", ".#.", "..."], 4, 0, 8, []),  # around is as short as through
        (["...", ".#.", "..."], 8, 0, 8, [4]),  # 4 around (corners are not cut), 2√2 through
        ([".#", ".."], 8, 0, 3, [1]),  # frees the diagonal past it
        (
            [".....#", "....#.", "......"],
            8,
            11,
            7,
            [10],
        ),  # opening 5 is no gain: 10 still prevents the diagonal
        ([".#.", ".#.", ".#."], 4, 3, 5, [1, 4, 7]),  # nothing else connects the two sides
        ([".##."], 4, 0, 3, []),  # opening one of two is not enough
        ([".?.", "..."], 4, 0, 2, []),  # unknown is no obstacle
        ([".#."], 4, 1, 2, [1]),  # somebody stood in it
        (["..#"], 4, 0, 2, [2]),  # the goal lies in it
    ],
)
def test_relevant_obstacles_by_hand(drawing, connectivity, visited, goal, expected):
    truth = grid_of(*drawing, connectivity=connectivity)
    relevant = relevant_obstacles(truth, array(visited), array(goal))
    assert relevant.shape == truth.shape
    assert np.flatnonzero(relevant).tolist() == expected


def relevant_by_force(truth, visited, goals):
    """Open every obstacle in turn and measure all ways again."""
    before = dijkstra(walkable_graph(truth))[visited, goals]
    relevant = np.zeros(truth.size, dtype=bool)
    for cell in np.flatnonzero(truth.known == Cell.OCCUPIED):
        known = truth.known.copy()
        known.flat[cell] = Cell.FREE
        after = dijkstra(walkable_graph(replace(truth, known=known)))[visited, goals]
        relevant[cell] = (after < before - 1e-9).any()
    return relevant.reshape(truth.shape)


@pytest.mark.parametrize("connectivity", [4, 8])
@pytest.mark.parametrize("obstacles", [0.15, 0.35, 0.6])
def test_relevant_obstacles_agree_with_opening_each(connectivity, obstacles):
    random = np.random.default_rng(7)
    found = 0
    for _ in range(60):
        shape = tuple(random.integers(1, 8, size=2))
        shares = [0.05, 0.95 - obstacles, obstacles]
        known = random.choice([Cell.UNKNOWN, Cell.FREE, Cell.OCCUPIED], size=shape, p=shares).astype(np.int64)
        truth = Grid(known, connectivity=connectivity)
        visited, goals = random.integers(0, truth.size, size=(2, random.integers(1, 6)))
        expected = relevant_by_force(truth, visited, goals)
        np.testing.assert_array_equal(relevant_obstacles(truth, visited, goals), expected, str(known))
        found += expected.sum()
    assert found > 20


def test_no_visits_make_nothing_relevant():
    assert not relevant_obstacles(grid_of(".#."), array(), array()).any()


# scores of a map


def test_map_scores_by_hand():
    truth = grid_of("##..", "?#..")
    blocked = np.array([[0.9, 0.3, 0.6, 0.1], [1.0, 0.5, 0.2, 0.99]])
    scored = np.array([[True, True, True, True], [True, True, True, False]])
    relevant = np.zeros((2, 4), dtype=bool)
    relevant[0, 1] = True
    scores = score_map(blocked, truth, scored, relevant)
    # obstacles .9 .3 .5, free .6 .1 .2; .9 beats 3, .3 beats 2, .5 beats 2
    assert scores.auc == pytest.approx(7 / 9)
    # ranked .9+ .6− .5+ .3+: precision 1, 2/3, 3/4 at the obstacles
    assert scores.average_precision == pytest.approx((1 + 2 / 3 + 3 / 4) / 3)
    assert scores.auc_relevant == pytest.approx(2 / 3)
    assert scores.average_precision_relevant == pytest.approx(1 / 2)
    assert scores.recall == pytest.approx(2 / 3)  # .5 counts
    assert scores.mean_obstacle == pytest.approx(1.7 / 3)
    assert scores.mean_free == pytest.approx(0.3)
    assert scores.max_probability == 0.9  # neither the unknown cell nor the one that is not scored


def test_what_has_nothing_to_average_is_none():
    nothing = np.zeros((1, 2), dtype=bool)
    no_obstacle = score_map(np.array([[0.2, 0.4]]), grid_of(".."), ~nothing, nothing)
    assert (no_obstacle.auc, no_obstacle.average_precision, no_obstacle.recall) == (None, None, None)
    assert (no_obstacle.mean_obstacle, no_obstacle.max_probability) == (None, 0.4)
    assert no_obstacle.mean_free == pytest.approx(0.3)
    none_relevant = score_map(np.array([[0.2, 0.4]]), grid_of(".#"), ~nothing, nothing)
    assert (none_relevant.auc, none_relevant.auc_relevant) == (1.0, None)
    assert none_relevant.average_precision_relevant is None
    unscored = score_map(np.array([[0.2, 0.4]]), grid_of(".#"), nothing, nothing)
    assert set(vars(unscored).values()) == {None}


def test_map_scores_refuse_other_shapes_and_nan():
    flags = np.ones((2, 2), dtype=bool)
    with pytest.raises(InputError, match=r"'blocked': expected the map's shape \(1, 2\), found \(2, 2\)"):
        score_map(np.zeros((2, 2)), grid_of(".."), flags, flags)
    flags = np.ones((1, 2), dtype=bool)
    with pytest.raises(InputError, match="'blocked': expected finite numbers"):
        score_map(np.array([[0.0, np.nan]]), grid_of(".."), flags, flags)


# scores of paths


def test_path_scores_by_hand():
    truth = grid_of("...", ".#.", "...", "###", "...")
    paths = [
        array(0, 1, 2),  # shortest
        array(0, 3, 6, 7, 8, 5, 2),  # 4 too long
        array(3, 4, 5),  # through the obstacle
        array(0, 2),  # jumps
        array(0, 1),  # does not arrive
        array(0, 0, 1, 2),  # stands still
        array(6, 5),  # neighbours in number, not in space
        array(7),  # is there already
        array(0, 12),  # cannot get there: left out
    ]
    scores = score_paths(paths, [2, 2, 5, 2, 2, 2, 5, 7, 12], truth)
    assert scores.legal_share == pytest.approx(3 / 8)
    assert scores.excess_length == pytest.approx(4 / 3)


def test_diagonal_paths():
    truth = grid_of("...", "..#", "...", connectivity=8)
    scores = score_paths([array(0, 1, 4, 8), array(1, 4, 7, 8), array(0, 4, 7)], [8, 8, 7], truth)
    assert scores.legal_share == pytest.approx(2 / 3)  # 4 → 8 cuts the corner at 5
    assert scores.excess_length == pytest.approx(0)
    longer = score_paths([array(0, 1, 4)], np.array([4]), truth)
    assert longer.excess_length == pytest.approx(2 - ROOT_TWO)


def test_a_path_within_an_obstacle_is_left_out():
    scores = score_paths([array(1), array(0, 1)], [1, 1], grid_of(".#"))
    assert (scores.legal_share, scores.excess_length) == (None, None)


def test_no_legal_path_has_no_excess():
    scores = score_paths([array(0, 2)], [2], grid_of("..."))
    assert (scores.legal_share, scores.excess_length) == (0.0, None)
    assert score_paths([], [], grid_of(".")).legal_share is None


# refusals and the baseline


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda grid: score_paths([array(0), array()], [0, 0], grid),
            "path, row 2: expected at least one state",
        ),
        (
            lambda grid: score_paths([array(0)], [0, 1], grid),
            "'goals': expected 1, one for each path, found 2",
        ),
        (lambda grid: score_paths([array(0, 3)], [0], grid), "'paths': expected states in 0…2"),
        (lambda grid: score_paths([array(0)], [-1], grid), "'goals': expected states in 0…2"),
        (lambda grid: relevant_obstacles(grid, array(3), array(0)), "'visited': expected states in 0…2"),
        (lambda grid: relevant_obstacles(grid, array(0), array(3)), "'goals': expected states in 0…2"),
        (lambda grid: visit_ranking(array(-1), grid), "'visited': expected states in 0…2"),
    ],
)
def test_refusals(call, message):
    with pytest.raises(InputError) as caught:
        call(grid_of("..."))
    assert message in str(caught.value)


def test_cells_rarely_visited_rank_highest():
    ranking = visit_ranking(array(0, 2, 2), grid_of("..", ".#"))
    np.testing.assert_array_equal(ranking, [[-1, 0], [-2, 0]])
