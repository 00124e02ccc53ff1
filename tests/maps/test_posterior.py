"""The posterior of a map: which method, which prior, how many sweeps, and the samples of a learned map."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.drawn import grid_of, walk_along
from helpers.office import BLANK, simulated
from helpers.walled import BLANK as ROOM
from helpers.walled import walks as room_walks
from sidestep.errors import InputError
from sidestep.inference.coordinate_ascent import BarrierMeanField
from sidestep.inference.fit import Fit
from sidestep.inference.maximize import Status
from sidestep.inference.mrf import SHAPE_TERMS
from sidestep.inference.sampler import BarrierPosterior
from sidestep.maps.config import (
    LOG_ODDS,
    MAX_SAMPLED,
    NEAR_OPTIMAL,
    SHAPE_WEIGHTS,
    SOFT,
    BehaviorConfig,
    FitConfig,
    MapConfig,
    PosteriorConfig,
    PriorConfig,
)
from sidestep.maps.fit import MapSize, barrier_prior, infer_map, posterior_method, sweeps_for
from sidestep.maps.learn import learn_map
from sidestep.maps.learned_map import LearnedMap, load_map
from sidestep.maps.sensors import SensorMap, cell_field, first_logits
from sidestep.tabular.grid import Cell
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.reward import Reward

NORMAL, FEW = PriorConfig("normal"), PosteriorConfig("sample", sweeps=15)


# Configurations


def test_behavior_config_refuses_unknown_parameters():
    with pytest.raises(InputError, match="field 'learn': expected one of beta, lapse, discount, found 'mood'"):
        BehaviorConfig(learn=("mood",))


def test_posterior_method_by_prior_size_and_horizon():
    config = MapConfig()
    assert posterior_method(config, MapSize(MAX_SAMPLED // 500, 100, 5)) == "sample"
    assert posterior_method(config, MapSize(MAX_SAMPLED // 500 + 1, 100, 5)) == "mean_field"
    ahead = MapConfig(behavior=BehaviorConfig(horizon=3))
    assert posterior_method(ahead, MapSize(10, 10, 1)) == "mean_field"
    assert posterior_method(MapConfig(prior=NORMAL), MapSize(10, 10, 1)) == "mode"


@pytest.mark.parametrize("method", ["sample", "mean_field"])
def test_posterior_method_configured_does_not_depend_on_the_size(method):
    config = MapConfig(posterior=PosteriorConfig(method))
    assert {posterior_method(config, MapSize(unknown, 10**7, 7)) for unknown in (0, 10, 10**7)} == {method}


def test_sweeps_for_fall_with_the_size_between_bounds():
    sizes = [0, 1, 100, 1_000, 6_000, 30_000, 10**5]
    fewest, most = zip(*(sweeps_for(MapConfig(), MapSize(size, size, 5)) for size in sizes), strict=True)
    for sweeps in (fewest, most):
        assert list(sweeps) == sorted(sweeps, reverse=True)
        assert sweeps[0] == sweeps[2] > sweeps[-1] == sweeps[-2] >= 12
    assert all(first <= last for first, last in zip(fewest, most, strict=True))
    assert fewest[0] < most[0]
    # what counts is the product
    assert sweeps_for(MapConfig(), MapSize(3_000, 3_000, 5)) == sweeps_for(MapConfig(), MapSize(5, 9_000, 3_000))
    assert sweeps_for(MapConfig(posterior=PosteriorConfig(sweeps=77)), MapSize(10**5, 10**5, 5)) == (77, 77)


@pytest.mark.parametrize(("make", "field"), [
    (lambda: PosteriorConfig(sweeps=11), "sweeps"),
    (lambda: PosteriorConfig(chains=1), "chains"),
    (lambda: PriorConfig(log_odds=float("nan")), "log_odds"),
    (lambda: PriorConfig(isolated=float("inf")), "isolated"),
    (lambda: MapConfig(posterior=PosteriorConfig("mode")), "posterior"),
    (lambda: MapConfig(prior=NORMAL, posterior=PosteriorConfig("sample")), "posterior"),
    (lambda: MapConfig(prior=NORMAL, posterior=PosteriorConfig("mean_field")), "posterior"),
])  # fmt: skip
def test_config_out_of_range_or_of_another_prior_raises(make, field):
    with pytest.raises(InputError, match=f"'{field}'"):
        make()


# Priors


@pytest.mark.parametrize("method", ["sample", "mean_field"])
def test_barrier_prior_has_the_weights_of_its_method_and_those_given(method):
    known = np.full((2, 3), -1)
    default = barrier_prior(PriorConfig(), known, method)
    assert default.shape == (2, 3)
    assert {name: getattr(default, name) for name in SHAPE_TERMS} == SHAPE_WEIGHTS[method]
    np.testing.assert_array_equal(default.field, LOG_ODDS)
    config = PriorConfig(log_odds=-0.5, lines=0.0, blocks=1.5)
    given = barrier_prior(config, known, method)
    expected = SHAPE_WEIGHTS[method] | {"lines": 0.0, "blocks": 1.5}
    assert {name: getattr(given, name) for name in SHAPE_TERMS} == expected
    np.testing.assert_array_equal(given.field, -0.5)


def test_cell_field_of_a_sensor_is_the_log_odds_of_the_mean_probability():
    """E[σ(x)] of a normal x by a sum over its quantiles; MacKay's approximation is within a hundredth."""
    probability, variance = np.array([[0.02, 0.3, 0.5], [0.7, 0.9, 0.98]]), np.array([[0.5, 2.0, 8.0]] * 2)
    known = np.full((2, 3), -1)
    field = cell_field(SensorMap(probability, variance), known, PriorConfig())
    normal = np.random.default_rng(0).normal(size=(200_000, 1, 1))
    logits = np.log(probability / (1 - probability)) + np.sqrt(variance) * normal
    np.testing.assert_allclose(1 / (1 + np.exp(-field)), (1 / (1 + np.exp(-logits))).mean(axis=0), atol=0.015)


def test_cell_field_where_sensors_saw_nothing_is_that_of_the_prior():
    probability = np.array([[0.9, np.nan, 0.9, 0.9]])
    sensor = SensorMap(probability, np.array([[1.0, 1.0, np.inf, 1.0]]))
    field = cell_field(sensor, np.array([[-1, -1, -1, 0]]), PriorConfig(log_odds=-1.0))
    np.testing.assert_array_equal(field[0, 1:], -1.0)
    assert field[0, 0] > 1
    np.testing.assert_array_equal(cell_field(None, np.full((1, 2), -1), PriorConfig()), LOG_ODDS)


def test_cell_field_of_a_sensor_that_is_sure_is_finite():
    field = cell_field(SensorMap(np.array([[0.0, 1.0]])), np.full((1, 2), -1), PriorConfig())
    assert np.isfinite(field).all()
    assert field[0, 0] < -2 < 2 < field[0, 1]


def test_first_logits_are_those_of_the_prior():
    sensor, known = SensorMap(np.array([[0.9, np.nan]])), np.full((1, 2), -1)
    binary, normal = PriorConfig(log_odds=-3.0), PriorConfig("normal", mean=0.7)
    np.testing.assert_array_equal(first_logits(sensor, known, binary), cell_field(sensor, known, binary).ravel())
    np.testing.assert_allclose(first_logits(sensor, known, normal), [np.log(9), 0.7])
    np.testing.assert_array_equal(first_logits(None, known, binary), -3.0)
    assert binary.first_logit == -3.0


# Inference


def inferred(config: MapConfig, **settings: Any) -> Any:
    return infer_map(ObstacleGrid(ROOM, config.prior.first_logit), room_walks(), config, **settings)


@pytest.mark.slow
@pytest.mark.parametrize(("method", "kind"), [("sample", BarrierPosterior), ("mean_field", BarrierMeanField)])
def test_infer_map_has_the_method_of_the_configuration(method, kind):
    result = inferred(MapConfig(behavior=BehaviorConfig(beta=7.0), posterior=PosteriorConfig(method, sweeps=60)))
    assert isinstance(result, kind)
    visited = room_walks().visited_state_goals()[:, 0]
    blocked = np.asarray(result.model.blocked).ravel()
    wall = np.array([2, 7, 12, 17])
    assert blocked[wall].min() > 0.5 > 0.3 > blocked[visited].max()


@pytest.mark.slow
def test_infer_map_mean_field_with_a_horizon_is_a_fit():
    config = MapConfig(behavior=BehaviorConfig(horizon=9), posterior=PosteriorConfig("mean_field"))
    assert isinstance(inferred(config), Fit)


def test_infer_map_mean_field_stops_at_max_iterations():
    config = MapConfig(posterior=PosteriorConfig("mean_field"), fit=FitConfig(max_iterations=1))
    result = inferred(config)
    assert len(result.history) == 1
    assert result.status is Status.MAX_ITERATIONS


@pytest.mark.slow
def test_infer_map_normal_prior_is_a_fit():
    assert isinstance(inferred(MapConfig(prior=NORMAL)), Fit)


def test_infer_map_sampled_with_a_horizon_raises():
    config = MapConfig(behavior=BehaviorConfig(horizon=5), posterior=FEW)
    with pytest.raises(InputError, match=r"'horizon'.*mean_field"):
        inferred(config)


def test_infer_map_passes_settings_on_to_the_sampler():
    reports: list[Any] = []
    prior = PriorConfig(log_odds=LOG_ODDS)  # of known density, so that only the chains depend on the seed
    posterior = PosteriorConfig("sample", sweeps=15, chains=3)
    config = MapConfig(behavior=BehaviorConfig(beta=7.0), prior=prior, posterior=posterior, seed=5)
    result = inferred(config, callback=reports.append)
    assert result.samples.shape[:2] == (3, 10)
    assert len(reports) == 15
    assert reports[-1].total == 15
    again = inferred(config)
    np.testing.assert_array_equal(result.samples, again.samples)
    other = inferred(replace(config, seed=6))
    assert (result.samples != other.samples).any()
    tempered = inferred(replace(config, behavior=BehaviorConfig(tempering=0.2)))
    assert abs(tempered.final.actions) < abs(result.final.actions)
    alone = inferred(replace(config, fit=FitConfig("transitions")))
    assert all(each.actions == 0 > each.transitions for each in alone.history)


@pytest.mark.slow
def test_infer_map_with_a_learned_beta_samples_with_it():
    config = MapConfig(behavior=BehaviorConfig(beta=2.0, learn=("beta",)), posterior=FEW)
    result = inferred(config)
    learned = result.learned_behavior["beta"]
    assert float(result.behavior.behavior_of().beta) == pytest.approx(learned.estimate)
    assert learned.estimate != 2.0
    assert result.summary()["learned_behavior"]["beta"]["estimate"] == learned.estimate


# Learned maps


def corridor_map(**settings: Any) -> LearnedMap:
    grid = grid_of("??.", "#??")
    walks = walk_along([(0.5, 1.5), (1.5, 1.5), (2.5, 1.5)], [(2.5, 0.5), (2.5, 1.5)])
    own: dict[str, Any] = {"posterior": PosteriorConfig(sweeps=15)} | settings
    return learn_map(grid, walks, MapConfig(**own))


def test_learn_map_keeps_samples_of_the_posterior(tmp_path):
    learned = corridor_map()
    samples, known = learned.samples, learned.grid.known
    assert samples is not None
    assert samples.shape == (20, 2, 3)
    assert (samples[:, known == Cell.OCCUPIED]).all()
    assert not samples[:, known == Cell.FREE].any()
    assert not samples[:, 0].any()  # walks passed
    means = (samples.sum(axis=0) + 0.5) / 21
    np.testing.assert_allclose(learned.blocked, np.where(known == Cell.UNKNOWN, means, known == Cell.OCCUPIED))
    learned.save(tmp_path)
    loaded = load_map(tmp_path).samples
    assert loaded is not None
    assert loaded.dtype == bool
    np.testing.assert_array_equal(loaded, samples)


@pytest.mark.slow
def test_learn_map_keeps_at_most_400_samples():
    samples = corridor_map(posterior=PosteriorConfig(sweeps=700)).samples
    assert samples is not None
    assert 200 < len(samples) <= 400


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{"posterior": PosteriorConfig("mean_field")}, {"prior": NORMAL}])
def test_learn_map_by_a_fit_has_no_samples(tmp_path, settings):
    corridor_map().save(tmp_path)
    assert (tmp_path / "samples.npz").exists()
    fitted = corridor_map(**{"posterior": PosteriorConfig()} | settings)
    assert fitted.samples is None
    fitted.save(tmp_path)
    assert not (tmp_path / "samples.npz").exists()
    assert load_map(tmp_path).samples is None


BAD_SAMPLES = {
    "another shape": np.zeros((4, 3, 2), bool),
    "one map": np.zeros((2, 3), bool),
    "no map": np.zeros((0, 2, 3), bool),
    "numbers": np.zeros((4, 2, 3)),
}


@pytest.fixture
def saved(tmp_path):
    grid = grid_of("?.#", "???")
    blocked = np.where(grid.known == Cell.UNKNOWN, 0.5, grid.known)
    LearnedMap(grid, blocked, np.array([[0, 2]]), Reward(), samples=np.zeros((4, 2, 3), bool)).save(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", BAD_SAMPLES)
def test_load_map_refuses_samples_that_do_not_fit(saved, name):
    np.savez(saved / "samples.npz", blocked=BAD_SAMPLES[name])
    with pytest.raises(InputError, match=r"samples\.npz"):
        load_map(saved)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 no archive", b"text"])
def test_load_map_names_samples_that_are_no_archive(saved, content):
    (saved / "samples.npz").write_bytes(content)
    with pytest.raises(InputError, match=r"samples\.npz"):
        load_map(saved)


def test_load_map_refuses_samples_by_another_name(saved):
    np.savez(saved / "samples.npz", closed=np.zeros((4, 2, 3), bool))
    with pytest.raises(InputError, match=r"samples\.npz"):
        load_map(saved)


@pytest.mark.slow
def test_learn_map_resumed_equals_uninterrupted(tmp_path):
    """Also where a fit of the behavior comes first."""
    walks = simulated(walks=12, goals=2)
    for number, behavior in enumerate((BehaviorConfig(), BehaviorConfig(learn=("lapse",)))):
        config = MapConfig(behavior=behavior, posterior=FEW)
        checkpoint = tmp_path / f"{number}.checkpoint"

        def interrupt(progress: Any) -> None:
            if progress.total == 15 and progress.iteration == 6:
                raise KeyboardInterrupt

        expected = learn_map(BLANK, walks, config)
        with pytest.raises(KeyboardInterrupt):
            learn_map(BLANK, walks, config, callback=interrupt, checkpoint=checkpoint)
        assert checkpoint.exists()
        resumed = learn_map(BLANK, walks, config, checkpoint=checkpoint, resume=True)
        np.testing.assert_array_equal(resumed.blocked, expected.blocked)
        assert resumed.samples is not None
        assert expected.samples is not None
        np.testing.assert_array_equal(resumed.samples, expected.samples)


def test_sampled_model_has_logits_of_its_probabilities():
    result = inferred(MapConfig(posterior=FEW))
    np.testing.assert_allclose(jax.nn.sigmoid(jnp.asarray(result.model.parameters)), result.closed, atol=1e-6)


def test_agents_are_near_optimal_unless_something_of_them_is_set_or_learned():
    assert MapConfig().agents == MapConfig(behavior=BehaviorConfig("logsumexp")).agents == NEAR_OPTIMAL
    assert MapConfig(behavior=BehaviorConfig(beta=3.0)).agents == SOFT._replace(beta=3.0)
    assert MapConfig(behavior=BehaviorConfig(lapse=0.2)).agents == SOFT._replace(lapse=0.2)
    assert MapConfig(behavior=BehaviorConfig(tempering=0.7)).agents == SOFT._replace(tempering=0.7)
    assert MapConfig(behavior=BehaviorConfig(learn=("discount",))).agents == SOFT
    assert MapConfig(prior=PriorConfig("normal")).agents == SOFT


def test_completed_has_the_same_agents():
    for config in (MapConfig(), MapConfig(prior=PriorConfig("normal"))):
        assert config.completed().agents == config.agents
    assert replace(MapConfig().completed(), prior=PriorConfig("normal")).agents == NEAR_OPTIMAL
