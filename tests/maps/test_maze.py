"""Forty walks of real people through a maze with hidden walls."""

from pathlib import Path

import pytest

from helpers.office import call, summary

MAZE = Path(__file__).parents[3] / "shared" / "data" / "tartarus" / "maze_01"


@pytest.mark.slow
@pytest.mark.skipif(not MAZE.exists(), reason="the walks of de Cothi et al. (2022) are not here")
def test_learn_of_40_walks_finds_the_walls_of_a_maze(tmp_path):
    walks, blank, truth = MAZE / "humans.csv", MAZE / "blank.yaml", MAZE / "truth.yaml"
    assert call("learn", walks, "--map", blank, "--out", tmp_path, "--max-walks", 40) == 0
    assert call("evaluate", tmp_path, "--true-map", truth) == 0
    scores = summary(tmp_path)
    assert scores["converged"]
    assert scores["auc"] >= 0.9
    assert scores["average_precision"] >= 0.7
