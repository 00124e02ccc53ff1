"""What walks say of each cell, and which cells stay unknown."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from helpers.drawn import grid_of, walk_along
from sidestep.errors import InputError
from sidestep.maps.config import BehaviorConfig, FitConfig, MapConfig, PosteriorConfig, PriorConfig
from sidestep.maps.information import LinearEvidence
from sidestep.maps.learn import learn_map
from sidestep.maps.learned_map import LearnedMap
from sidestep.maps.sensors import SensorMap
from sidestep.tabular.grid import Cell

ROOM = grid_of(
    "???????",
    "???????",
    "???####",
    "???#???",
    "???#???",
    "???#???",
)  # fmt: skip
"""The room at the lower right has no door."""
INSIDE = np.zeros(ROOM.shape, bool)
INSIDE[3:, 4:] = True
PATHS = [(0.5, y + 0.5) for y in range(6)] + [(x + 0.5, 5.5) for x in range(1, 7)]
"""Up along the left side, and right along the upper one."""
CONFIGS = {
    "sample": MapConfig(posterior=PosteriorConfig("sample", sweeps=600)),
    "mean_field": MapConfig(posterior=PosteriorConfig("mean_field")),
    "mode": MapConfig(prior=PriorConfig("normal")),
}


def learned_room(config: MapConfig, **inputs: Any) -> LearnedMap:
    return learn_map(ROOM, walk_along(*[PATHS, PATHS[::-1]] * 4), config, **inputs)


def visited(learned: LearnedMap) -> np.ndarray:
    return np.isin(np.arange(learned.grid.size), learned.visited[:, 0]).reshape(learned.grid.shape)


@pytest.fixture(scope="module")
def sampled() -> LearnedMap:
    return learned_room(CONFIGS["sample"])


def check_room(learned: LearnedMap) -> None:
    passed, nats = visited(learned), learned.information
    assert passed.sum() == 12
    assert nats is not None
    assert not nats[ROOM.known != Cell.UNKNOWN].any()
    assert learned.without_evidence[INSIDE].all()
    assert not learned.without_evidence[passed].any()
    assert nats[passed].min() > 2 * nats[INSIDE].max()


def test_map_information_of_a_room_without_a_door_is_next_to_none(sampled):
    check_room(sampled)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mean_field", "mode"])
def test_map_information_of_a_fit_in_a_room_without_a_door_is_none(name):
    learned = learned_room(CONFIGS[name])
    check_room(learned)
    assert learned.information is not None
    assert learned.information[INSIDE].max() < 0.005


@pytest.mark.slow
def test_map_information_of_a_fit_that_ended_early_is_none_in_the_room():
    """A fit of a large map begins with blocked cells: after one iteration the room is as blocked as at first."""
    early = FitConfig(large_map=1, max_iterations=1)
    learned = learned_room(replace(CONFIGS["mean_field"], fit=early, behavior=BehaviorConfig(horizon=40)))
    assert learned.blocked[INSIDE].min() > 0.9
    assert learned.information is not None
    inside = learned.information[INSIDE].max()
    assert inside < 0.005
    assert learned.information[visited(learned)].min() > 5 * inside


@pytest.mark.slow
def test_map_information_of_cells_that_sensors_saw_is_theirs():
    """Cells of the room, independent of each other: one that is occupied for sure, and one that the sensors missed."""
    seen = np.full(ROOM.shape, np.nan)
    seen[4, 5] = 0.99
    config = MapConfig(prior=PriorConfig("normal", wall_prior=0.0, mean=-1.0))
    learned = learned_room(config, sensor=SensorMap(seen))
    assert learned.information is not None
    assert learned.information[4, 5] > 1
    assert not learned.without_evidence[4, 5]
    assert learned.without_evidence[INSIDE].sum() == 8


def test_without_evidence_never_has_cells_that_walks_crossed(sampled):
    everything = replace(sampled, unknown_below=100.0)
    expected = (ROOM.known == Cell.UNKNOWN) & ~visited(sampled)
    np.testing.assert_array_equal(everything.without_evidence, expected)


def test_without_evidence_below_0_nats_is_empty(sampled):
    assert not replace(sampled, unknown_below=0.0).without_evidence.any()
    assert not replace(sampled, information=None).without_evidence.any()


@pytest.mark.parametrize("threshold", [0.0, 0.05])
def test_save_writes_cells_without_evidence_as_unknown(sampled, tmp_path, threshold):
    learned = replace(sampled, unknown_below=threshold)
    learned.save(tmp_path)
    pixels = np.asarray(Image.open(tmp_path / "map.pgm"))
    np.testing.assert_array_equal(pixels == 205, learned.without_evidence)
    written = ~learned.without_evidence
    assert np.abs(pixels[written] - 100 * learned.blocked[written]).max() <= 0.5
    assert written.all() == (threshold == 0)


@pytest.mark.parametrize("threshold", [-0.1, float("nan"), float("inf")])
def test_config_with_another_threshold_raises(threshold):
    with pytest.raises(InputError, match="'unknown_below': expected a finite number, at least 0"):
        MapConfig(unknown_below=threshold)


def test_linear_evidence_adds_slopes_times_probabilities():
    import jax.numpy as jnp

    from sidestep.inference.priors import Normal

    prior, logits = Normal(-1.0, 2.0), jnp.array([0.5, -3.0])
    added = LinearEvidence(prior, jnp.array([2.0, -4.0])).log_density(logits) - prior.log_density(logits)
    assert float(added) == pytest.approx(2 / (1 + np.exp(-0.5)) - 4 / (1 + np.exp(3.0)), rel=1e-6)
