"""Simulation-based calibration on small maps: the model, the quantities, wrong draws, and the command."""

import json
from dataclasses import replace

import numpy as np
import pytest

import sidestep as ss
from sidestep.cli.app import main
from sidestep.errors import InputError
from sidestep.evaluation.ranks import band_excess, uniform_band
from sidestep.experiments.calibration import case_result, rank_scores, ranks_of, thinned
from sidestep.experiments.calibration_cases import (
    QUANTITIES,
    CalibrationConfig,
    draw_case,
    quantities_of,
    simulate_walks,
    world_of,
)
from sidestep.inference.chain_evidence import PASSING
from sidestep.inference.prior_chains import sample_prior

SMALL = CalibrationConfig(maps=30, rows=5, walks=8, moves=10, sweeps=60, draws=20)
SIDE = SMALL.rows


def quantities(closed):
    """Return the length of the path, and whether the door is open, of a map drawn as rows of 0 and 1."""
    maps = np.array([[character == "1" for character in closed.replace(" ", "")]])
    walks = simulate_walks(SMALL, np.zeros(SIDE**2, bool), 0)
    length, _, is_open = quantities_of(SMALL, walks, maps)[0]
    return length, is_open


@pytest.mark.parametrize(
    ("closed", "length", "is_open"),
    [
        ("00000 00000 00000 00000 00000", 4, 1),
        ("00000 00000 00100 00000 00000", 6, 0),
        ("00000 00000 11111 00000 00000", np.inf, 0),
        ("00000 00000 11011 00000 00000", 4, 1),
        ("00000 01110 00000 00000 00000", 8, 1),
    ],
)
def test_quantities_of_a_map_are_its_shortest_path_and_its_door(closed, length, is_open):
    assert quantities(closed) == (length, is_open)


def test_quantities_of_equal_maps_are_equal_and_their_likelihood_is_that_of_the_world():
    case = draw_case(SMALL, np.random.default_rng(3))
    other = ~case.closed & (SMALL.grid.known.ravel() == ss.Cell.UNKNOWN)
    found = quantities_of(SMALL, case.walks, np.stack([case.closed, other, case.closed]))
    assert found[0].tolist() == found[2].tolist()
    behavior = ss.Behavior(ss.BoltzmannAverage(), SMALL.learning("sample").agents.beta)
    for closed, (_, log_likelihood, _) in zip((case.closed, other), found, strict=False):
        assert log_likelihood == float(ss.log_likelihood(world_of(SMALL, closed), case.walks, behavior).total)


def test_world_of_a_map_has_the_probabilities_of_the_sampler():
    closed = np.zeros(SIDE**2, bool)
    closed[SMALL.door] = True
    world = world_of(SMALL, closed)
    above, right = SMALL.door - SIDE, SMALL.door + 1
    left_of_right = 2  # actions are up, down, left, right
    to_door = np.asarray(world.probabilities())[[above, right], [1, left_of_right], 0]
    np.testing.assert_allclose(to_door, PASSING[1], rtol=1e-5)
    to_open = np.asarray(world.probabilities())[above, left_of_right, 0]
    np.testing.assert_allclose(to_open, PASSING[0], rtol=1e-5)
    known = np.asarray(world.blocked).ravel()[[*SMALL.places, *SMALL.path_ends]]
    assert (known == 0).all()


def test_draw_case_has_walks_that_crossed_open_cells_only():
    for seed in range(10):
        case = draw_case(SMALL, np.random.default_rng(seed))
        paths = case.walks.paths()
        assert len(paths) == SMALL.walks
        assert not case.closed[np.concatenate(paths)].any()
        assert max(len(path) for path in paths) <= SMALL.moves + 1
        assert {path[0] for path in paths} <= set(SMALL.places)


def test_draw_case_with_equal_seeds_is_equal():
    first, second = (draw_case(SMALL, np.random.default_rng(5)) for _ in range(2))
    assert (first.closed == second.closed).all()
    assert [path.tolist() for path in first.walks.paths()] == [path.tolist() for path in second.walks.paths()]


@pytest.mark.slow
def test_ranks_of_draws_from_the_prior_show_that_they_ignore_the_walks():
    """The likelihood shows it; lengths and doors have the prior's distribution on the average over maps, as truths."""
    band, prior, known = uniform_band(SMALL.maps, SMALL.draws), SMALL.barrier_prior, SMALL.grid.known.ravel()
    ranks = []
    for seed in range(SMALL.maps):
        random = np.random.default_rng(seed)
        case = draw_case(SMALL, random)
        maps = np.concatenate([case.closed[None], sample_prior(prior, known, SMALL.draws, seed=seed)])
        truth, *draws = quantities_of(SMALL, case.walks, maps)
        ranks.append(ranks_of(truth, np.array(draws), random))
    excess = dict(zip(QUANTITIES, [band_excess(own, band) for own in np.array(ranks).T], strict=True))
    assert excess["log_likelihood"] > 0.2
    assert excess["path_length"] == excess["door"] == 0


@pytest.mark.slow
def test_case_result_of_the_sampler_is_calibrated():
    config = replace(SMALL, maps=10, sweeps=45)
    band, ranks = uniform_band(config.maps, config.draws), []
    for seed in range(config.maps):
        random = np.random.default_rng(seed)
        ranks.append(case_result(config, draw_case(config, random), random).sampler)
    for own in np.array(ranks).T:
        scores = rank_scores(own, band)
        assert scores["band_excess"] == 0
        assert scores["outside_90"] < 0.4


def test_thinned_takes_as_many_samples_of_each_chain_up_to_the_last():
    case = draw_case(SMALL, np.random.default_rng(0))
    posterior = ss.sample_barriers(
        ss.ObstacleGrid(SMALL.grid), case.walks, ss.Behavior(ss.BoltzmannAverage(), 7.0), prior=SMALL.barrier_prior,
        sweeps=15,
    )  # fmt: skip
    np.testing.assert_array_equal(thinned(posterior, 4), posterior.samples[:, [4, 9]].reshape(4, -1))
    with pytest.raises(InputError, match="expected at most 20, found 22"):
        thinned(posterior, 22)


def test_calibration_config_refuses_actions_of_another_weight():
    with pytest.raises(InputError, match="tempering"):
        CalibrationConfig(behavior=ss.BehaviorConfig())


@pytest.mark.parametrize("sizes", [{"maps": 0}, {"rows": 2}, {"walks": 1}, {"moves": 0}, {"sweeps": 11}, {"draws": 9}])
def test_calibration_config_refuses_sizes_out_of_range(sizes):
    with pytest.raises(InputError, match=next(iter(sizes))):
        CalibrationConfig(**sizes)


@pytest.mark.slow
def test_command_writes_the_picture_and_prints_the_table(tmp_path, capsys):
    sizes = {"maps": 2, "rows": 4, "walks": 4, "moves": 6, "sweeps": 12, "draws": 8}
    options = [part for name, number in sizes.items() for part in ("--size", f"{name}={number}")]
    assert main(["experiment", "calibration", "--out", str(tmp_path), "--seed", "1", *options]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert sizes.items() <= summary["settings"].items()
    assert summary["seed"] == 1
    assert (tmp_path / "calibration.png").read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr().out
    for quantity in QUANTITIES:
        for method, ranks in summary["ranks"][quantity].items():
            assert len(ranks) == 2
            assert all(0 <= each <= 8 for each in ranks)
            assert f"{method}, {quantity}" in printed
            scores = summary["table"][f"{method}, {quantity}"]
            assert scores == rank_scores(np.array(ranks), uniform_band(2, 8))


@pytest.mark.parametrize("size", ["maps", "maps=-1", "maps=1.5", "prior=1", "=3"])
def test_command_refuses_what_is_no_size(tmp_path, capsys, size):
    assert main(["experiment", "calibration", "--out", str(tmp_path), "--size", size]) == 2
    assert "maps, rows, walks" in " ".join(capsys.readouterr().err.split())
