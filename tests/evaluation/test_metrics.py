"""Scores of learned maps and planned paths: worked cases, scikit-learn, and brute force that opens each obstacle."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse.csgraph import dijkstra

from helpers.drawn import grid_of
from sidestep.errors import InputError
from sidestep.evaluation.metrics import ranking_scores, score_map, score_paths, visit_ranking
from sidestep.evaluation.relevance import relevant_obstacles
from sidestep.tabular.graph import walkable_graph
from sidestep.tabular.grid import Cell, Grid

ROOT_TWO = 2**0.5


def array(*states):
    return np.array(states, dtype=np.int64)


def test_walkable_graph_with_4_moves_has_no_diagonals():
    graph = walkable_graph(grid_of("..", ".#")).toarray()
    np.testing.assert_array_equal(graph, [[0, 1, 1, 0], [1, 0, 0, 0], [1, 0, 0, 0], [0, 0, 0, 0]])


def test_walkable_graph_with_8_moves_does_not_cut_corners():
    open_square = walkable_graph(grid_of("..", "..", connectivity=8)).toarray()
    assert open_square[0, 3] == open_square[2, 1] == pytest.approx(ROOT_TWO)
    corner = walkable_graph(grid_of("..", ".#", connectivity=8)).toarray()
    assert corner[1, 2] == corner[2, 1] == 0


def test_walkable_graph_leaves_out_unknown_cells():
    assert walkable_graph(grid_of(".?.")).nnz == 0


@pytest.mark.parametrize(("drawing", "connectivity", "visited", "goal", "expected"), [
    ([".#.", "..."], 4, 0, 2, [1]),  # 4 moves round it, 2 through it
    (["...", ".#.", "..."], 4, 0, 8, []),  # around is as short as through
    (["...", ".#.", "..."], 8, 0, 8, [4]),  # 4 around (corners are not cut), 2√2 through
    ([".#", ".."], 8, 0, 3, [1]),  # frees the diagonal past it
    # opening 5 is no gain: 10 still prevents the diagonal
    ([".....#", "....#.", "......"], 8, 11, 7, [10]),
    ([".#.", ".#.", ".#."], 4, 3, 5, [1, 4, 7]),  # nothing else connects the two sides
    ([".##."], 4, 0, 3, []),  # opening one of two is not enough
    ([".?.", "..."], 4, 0, 2, []),  # unknown is no obstacle
    ([".#."], 4, 1, 2, [1]),  # the visited state is in it
    (["..#"], 4, 0, 2, [2]),  # the goal lies in it
])  # fmt: skip
def test_relevant_obstacles_in_a_drawing_are_those_worked_out(drawing, connectivity, visited, goal, expected):
    truth = grid_of(*drawing, connectivity=connectivity)
    relevant = relevant_obstacles(truth, array(visited), array(goal))
    assert relevant.shape == truth.shape
    assert np.flatnonzero(relevant).tolist() == expected


def relevant_by_force(truth, visited, goals):
    """Open every obstacle in turn and measure all paths again."""
    before = dijkstra(walkable_graph(truth))[visited, goals]
    relevant = np.zeros(truth.size, dtype=bool)
    for cell in np.flatnonzero(truth.known == Cell.OCCUPIED):
        known = truth.known.copy()
        known.flat[cell] = Cell.FREE
        after = dijkstra(walkable_graph(replace(truth, known=known)))[visited, goals]
        relevant[cell] = (after < before - 1e-9).any()
    return relevant.reshape(truth.shape)


@pytest.mark.slow
@pytest.mark.parametrize("connectivity", [4, 8])
@pytest.mark.parametrize("obstacles", [0.15, 0.35, 0.6])
def test_relevant_obstacles_on_random_maps_equal_those_by_force(connectivity, obstacles):
    random = np.random.default_rng(7)
    total = 0
    for _ in range(30):
        shape = tuple(random.integers(1, 8, size=2))
        fractions = [0.05, 0.95 - obstacles, obstacles]
        known = random.choice([Cell.UNKNOWN, Cell.FREE, Cell.OCCUPIED], size=shape, p=fractions).astype(np.int64)
        truth = Grid(known, connectivity=connectivity)
        visited, goals = random.integers(0, truth.size, size=(2, random.integers(1, 6)))
        expected = relevant_by_force(truth, visited, goals)
        np.testing.assert_array_equal(relevant_obstacles(truth, visited, goals), expected, str(known))
        total += expected.sum()
    assert total > 10


@pytest.mark.parametrize("digits", [1, 12])
def test_ranking_scores_of_random_scores_equal_those_of_scikit_learn(digits):
    from sklearn.metrics import average_precision_score, roc_auc_score

    random = np.random.default_rng(0)
    for _ in range(50):
        positives, negatives = (random.normal(size=random.integers(1, 60)).round(digits) for _ in range(2))
        label = np.repeat([1, 0], [len(positives), len(negatives)])
        score = np.concatenate([positives, negatives])
        expected = roc_auc_score(label, score), average_precision_score(label, score)
        np.testing.assert_allclose(ranking_scores(positives, negatives), expected, rtol=1e-12)


def test_relevant_obstacles_without_visits_are_none():
    assert not relevant_obstacles(grid_of(".#."), array(), array()).any()


def test_score_map_equals_scores_worked_out():
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
    # .9 and .3 .5 and .6 .1 .2, all in bins of their own
    assert scores.calibration_error == pytest.approx((0.1 + 0.7 + 0.5 + 0.6 + 0.1 + 0.2) / 6)
    assert scores.brier_score == pytest.approx((0.01 + 0.49 + 0.25 + 0.36 + 0.01 + 0.04) / 6)
    assert scores.log_loss == pytest.approx(-np.log([0.9, 0.3, 0.5, 0.4, 0.9, 0.8]).mean())
    assert scores.recall == pytest.approx(2 / 3)  # .5 counts
    assert scores.mean_obstacle == pytest.approx(1.7 / 3)
    assert scores.mean_free == pytest.approx(0.3)
    assert scores.max_probability == 0.9  # neither the unknown cell nor the one that is not scored


def test_score_map_of_visit_counts_has_a_ranking_and_no_calibration():
    """Counts are no probabilities, also where the scored ones are 0 and 1 only by chance."""
    everywhere = np.ones((1, 3), dtype=bool)
    scores = score_map(np.array([[0.0, -4.0, -1.0]]), grid_of("#.."), everywhere, everywhere)
    assert scores.auc == scores.average_precision == 1
    assert scores.calibration_error is scores.brier_score is scores.log_loss is None
    unvisited = score_map(np.array([[1.0, 0.0, -4.0]]), grid_of("#.."), np.array([[True, True, False]]), everywhere)
    assert unvisited.auc == 1
    assert unvisited.calibration_error is unvisited.brier_score is unvisited.log_loss is None


def test_score_map_without_cells_to_average_is_none():
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


def test_score_map_with_another_shape_or_nan_raises():
    flags = np.ones((2, 2), dtype=bool)
    with pytest.raises(InputError, match=r"'blocked': expected numbers of shape \(1, 2\), found shape \(2, 2\)"):
        score_map(np.zeros((2, 2)), grid_of(".."), flags, flags)
    flags = np.ones((1, 2), dtype=bool)
    with pytest.raises(InputError, match="'blocked': expected finite numbers"):
        score_map(np.array([[0.0, np.nan]]), grid_of(".."), flags, flags)


def test_score_paths_equals_scores_worked_out():
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
    assert scores.legal_fraction == pytest.approx(3 / 8)
    assert scores.excess_length == pytest.approx(4 / 3)


def test_score_paths_with_diagonals_forbids_cut_corners():
    truth = grid_of("...", "..#", "...", connectivity=8)
    scores = score_paths([array(0, 1, 4, 8), array(1, 4, 7, 8), array(0, 4, 7)], [8, 8, 7], truth)
    assert scores.legal_fraction == pytest.approx(2 / 3)  # 4 → 8 cuts the corner at 5
    assert scores.excess_length == pytest.approx(0)
    longer = score_paths([array(0, 1, 4)], np.array([4]), truth)
    assert longer.excess_length == pytest.approx(2 - ROOT_TWO)


def test_score_paths_leaves_out_paths_within_obstacles():
    scores = score_paths([array(1), array(0, 1)], [1, 1], grid_of(".#"))
    assert (scores.legal_fraction, scores.excess_length) == (None, None)


def test_score_paths_without_legal_paths_has_no_excess_length():
    scores = score_paths([array(0, 2)], [2], grid_of("..."))
    assert (scores.legal_fraction, scores.excess_length) == (0.0, None)
    assert score_paths([], [], grid_of(".")).legal_fraction is None


@pytest.mark.parametrize(("call", "message"), [
    (lambda grid: score_paths([array(0), array()], [0, 0], grid), "path, row 2: expected at least one state"),
    (lambda grid: score_paths([array(0)], [0, 1], grid), "'goals': expected states of shape (1,), found shape (2,)"),
    (lambda grid: score_paths([array(0, 3)], [0], grid), "'paths[0]': expected states in 0…2"),
    (lambda grid: score_paths([array(0)], [-1], grid), "'goals': expected states in 0…2"),
    (lambda grid: relevant_obstacles(grid, array(3), array(0)), "'visited': expected states in 0…2"),
    (lambda grid: relevant_obstacles(grid, array(0), array(3)), "'goals': expected states in 0…2"),
    (lambda grid: visit_ranking(array(-1), grid), "'visited': expected states in 0…2"),
])  # fmt: skip
def test_metrics_with_invalid_arguments_raise(call, message):
    with pytest.raises(InputError) as caught:
        call(grid_of("..."))
    assert message in str(caught.value)


def test_visit_ranking_is_minus_the_number_of_visits():
    ranking = visit_ranking(array(0, 2, 2), grid_of("..", ".#"))
    np.testing.assert_array_equal(ranking, [[-1, 0], [-2, 0]])
