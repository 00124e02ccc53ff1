"""Calibration of probabilities: closed forms, scikit-learn, and the pooling of maps."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.drawn import grid_of
from sidestep.errors import InputError
from sidestep.evaluation.reliability import (
    BINS,
    LEAST_PROBABILITY,
    Reliability,
    brier_score,
    log_loss,
    map_reliability,
    reliability,
    scored_probabilities,
)

SCORES = [lambda *cells: reliability(*cells).calibration_error, brier_score, log_loss]


def error_of(counts: Reliability | None) -> float:
    """The calibration error, of a map that has one."""
    assert counts is not None
    assert counts.calibration_error is not None
    return counts.calibration_error


def flags(*numbers) -> np.ndarray:
    return np.array(numbers, dtype=bool)


def cells_with(fractions, each=100) -> tuple[np.ndarray, np.ndarray]:
    """The middles of the bins, and as many obstacles among `each` cells as the fractions of the bins say."""
    blocked = np.repeat((np.arange(BINS) + 0.5) / BINS, each)
    obstacle = np.concatenate([np.arange(each) < round(each * fraction) for fraction in fractions])
    return blocked, obstacle


def test_reliability_counts_cells_and_obstacles_by_bin():
    """An edge between bins belongs to the upper one, 1 to the last."""
    blocked = np.array([0.0, 0.05, 0.1, 0.3, 0.7, 0.95, 1.0])
    counts = reliability(blocked, flags(0, 1, 0, 0, 1, 1, 1))
    np.testing.assert_array_equal(counts.cells, [2, 1, 0, 1, 0, 0, 0, 1, 0, 2])
    np.testing.assert_array_equal(counts.obstacles, [1, 0, 0, 0, 0, 0, 0, 1, 0, 2])
    nan = np.nan
    np.testing.assert_allclose(counts.mean_prediction, [0.025, 0.1, nan, 0.3, nan, nan, nan, 0.7, nan, 0.975])
    np.testing.assert_allclose(counts.obstacle_fraction, [0.5, 0, nan, 0, nan, nan, nan, 1, nan, 1])
    # two cells at |.025 − .5|, one each at .1, .3, .3, two at .025
    assert counts.calibration_error == pytest.approx((2 * 0.475 + 0.1 + 0.3 + 0.3 + 2 * 0.025) / 7)


@pytest.mark.parametrize(("bias", "expected"), [(0.0, 0.0), (0.04, 0.04), (-0.03, 0.03)])
def test_calibration_error_of_a_constant_bias_is_the_bias(bias, expected):
    fractions = (np.arange(BINS) + 0.5) / BINS + bias
    assert reliability(*cells_with(fractions)).calibration_error == pytest.approx(expected)


def test_calibration_error_of_opposite_biases_in_one_bin_is_zero():
    assert reliability(np.array([0.42, 0.48]), flags(1, 0)).calibration_error == pytest.approx(0.05)
    assert reliability(np.array([0.42, 0.58]), flags(1, 0)).calibration_error == pytest.approx(0.58)


@pytest.mark.parametrize(("blocked", "brier", "loss"), [
    (0.5, 0.25, np.log(2)),
    (0.2, 0.25 * 0.64 + 0.75 * 0.04, -0.25 * np.log(0.2) - 0.75 * np.log(0.8)),
    (0.0, 0.25, -0.25 * np.log(LEAST_PROBABILITY) - 0.75 * np.log1p(-LEAST_PROBABILITY)),
    (1.0, 0.75, -0.75 * np.log(LEAST_PROBABILITY) - 0.25 * np.log1p(-LEAST_PROBABILITY)),
])  # fmt: skip
def test_brier_score_and_log_loss_of_a_constant_equal_closed_forms(blocked, brier, loss):
    """A quarter of the cells are obstacles."""
    cells = np.full(8, blocked), np.arange(8) < 2
    assert brier_score(*cells) == pytest.approx(brier)
    assert log_loss(*cells) == pytest.approx(loss)
    assert reliability(*cells).calibration_error == pytest.approx(abs(blocked - 0.25))


def test_brier_score_and_log_loss_of_random_cells_equal_those_of_scikit_learn():
    from sklearn import metrics

    random = np.random.default_rng(0)
    for _ in range(20):
        blocked = random.uniform(0.001, 0.999, size=random.integers(1, 60))
        obstacle = random.random(len(blocked)) < blocked
        label = obstacle.astype(int)
        assert brier_score(blocked, obstacle) == pytest.approx(metrics.brier_score_loss(label, blocked), rel=1e-12)
        assert log_loss(blocked, obstacle) == pytest.approx(metrics.log_loss(label, blocked, labels=[0, 1]), rel=1e-12)


probabilities = st.lists(st.floats(0, 1), min_size=1, max_size=30)


@given(probabilities, probabilities, st.randoms(use_true_random=False))
def test_reliability_of_two_maps_added_is_that_of_all_their_cells(first, second, random):
    blocked = np.array(first + second)
    obstacle = flags(*(random.random() < 0.5 for _ in blocked))
    own = slice(len(first)), slice(len(first), None)
    whole, parts = reliability(blocked, obstacle), [reliability(blocked[each], obstacle[each]) for each in own]
    pooled = parts[0] + parts[1]
    np.testing.assert_array_equal(pooled.cells, whole.cells)
    np.testing.assert_array_equal(pooled.obstacles, whole.obstacles)
    np.testing.assert_allclose(pooled.expected, whole.expected, atol=1e-12)
    assert 0 <= error_of(pooled) <= 1
    # by the triangle inequality pooling never raises the error above the mean over cells of the parts' errors
    mean = sum(part.cells.sum() * error_of(part) for part in parts)
    assert error_of(pooled) <= mean / len(blocked) + 1e-12


def test_calibration_error_of_many_small_calibrated_maps_vanishes_only_if_pooled():
    random = np.random.default_rng(0)
    maps = []
    for _ in range(400):
        blocked = random.random(25)
        maps.append(reliability(blocked, random.random(25) < blocked))
    pooled = sum(maps[1:], start=maps[0])
    assert np.mean([error_of(own) for own in maps]) > 0.15
    assert error_of(pooled) < 0.02


def test_scores_without_cells_are_none():
    assert [score(np.array([]), flags()) for score in SCORES] == [None, None, None]


@pytest.mark.parametrize("score", SCORES)
@pytest.mark.parametrize(("blocked", "field"), [([0.5, 1.01], "blocked"), ([-0.01, 0.5], "blocked"),
                                                ([0.5, np.nan], "blocked"), ([0.5], "obstacle")])  # fmt: skip
def test_scores_of_numbers_outside_0_to_1_or_of_another_length_raise(score, blocked, field):
    with pytest.raises(InputError, match=f"field '{field}'"):
        score(np.array(blocked), flags(0, 1))


def test_scored_probabilities_leaves_out_cells_that_nobody_knows_or_scores():
    truth, ranking = grid_of("#.?", "#.."), np.array([[0.9, 0.2, 0.5], [0.8, 0.1, 0.3]])
    scored = flags(1, 1, 1, 1, 1, 0).reshape(2, 3)
    cells = scored_probabilities(ranking, truth, scored)
    assert cells is not None
    np.testing.assert_array_equal(cells[0], [0.9, 0.2, 0.8, 0.1])
    np.testing.assert_array_equal(cells[1], [True, False, True, False])
    assert error_of(map_reliability(ranking, truth, scored)) == pytest.approx((0.1 + 0.2 + 0.2 + 0.1) / 4)


@pytest.mark.parametrize("other", [-1.0, 1.5])
def test_map_reliability_of_what_is_no_probability_is_none(other):
    """One number outside [0, 1] says so of all, even if that cell is not scored."""
    truth, scored = grid_of("#.."), flags(1, 1, 0).reshape(1, 3)
    assert map_reliability(np.array([[0.9, 0.1, other]]), truth, scored) is None
    assert map_reliability(np.array([[0.9, 0.1, 0.0]]), truth, scored) is not None
    assert map_reliability(None, truth, scored) is None
    assert map_reliability(np.array([[0.9, 0.1, 0.0]]), grid_of("???"), scored) is None
