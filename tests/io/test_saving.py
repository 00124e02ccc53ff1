"""Results written to files and read again, to the last bit; and files that are refused."""

import dataclasses
import enum
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sidestep as ss
import sidestep.continuous as sc
from sidestep.errors import InputError

GRID = ss.Grid.unknown(1, 3)
BEHAVIOR = ss.Behavior(ss.BoltzmannAverage(), 7.0)
PRIOR = ss.BinaryMRF(np.zeros(3), (1, 3))


def shown() -> ss.Demonstrations:
    return ss.gather([ss.Trajectory(np.array([0, 1]), np.array([3]), task=0)], [ss.reach(GRID, 1)])


def fit_of(model: Any, **options) -> ss.Fit:
    return ss.fit(model, shown(), ss.behavior_model(BEHAVIOR, ["beta", "lapse"]), **options)


def assert_same(one, other, path="result"):
    """The same classes, and the same bits in every field."""
    assert type(one) is type(other), path
    if isinstance(one, enum.Enum) or one is None or callable(one):
        assert one is other or dataclasses.is_dataclass(one), path
    if isinstance(one, np.ndarray | np.generic | jax.Array):
        assert (one.dtype, one.shape) == (other.dtype, other.shape), path
        assert np.asarray(one).tobytes() == np.asarray(other).tobytes(), path
    elif dataclasses.is_dataclass(one):
        for field in dataclasses.fields(one):
            assert_same(getattr(one, field.name), getattr(other, field.name), f"{path}.{field.name}")
    elif isinstance(one, Mapping):
        assert list(one) == list(other), path
        for key in one:
            assert_same(one[key], other[key], f"{path}[{key}]")
    elif isinstance(one, tuple | list):
        assert len(one) == len(other), path
        for at, pair in enumerate(zip(one, other, strict=True)):
            assert_same(*pair, f"{path}[{at}]")
    elif isinstance(one, float):
        # text has one NaN only
        assert np.float64(one).tobytes() == np.float64(other).tobytes() or (np.isnan(one) and np.isnan(other)), path
    elif isinstance(one, str | int):
        assert one == other, path


def rollout_fit():
    dynamics = sc.LinearGaussian(jnp.ones((1, 1)), jnp.ones((1, 1)), jnp.ones(1))
    task = sc.QuadraticTask(jnp.zeros(1), jnp.eye(1), jnp.eye(1), jnp.asarray(0.8))
    random = np.random.default_rng(0)
    walks = [ss.Trajectory(random.normal(size=(4, 1)), random.normal(size=(3, 1)), task=0)]
    demos = sc.gather_trajectories(walks, [task])
    policy = sc.gaussian_policy(jax.random.key(0), 1, demos.states, width=4, depth=1)
    short = sc.Schedule(iterations=8, policy_warmup=1, batch_size=2)
    planner = sc.Planner(horizon=2, batch_size=2, samples=2, candidates=2, critic_width=4, critic_steps=1)
    behavior = ss.Behavior(ss.LogSumExp(), 2.0)
    return sc.fit_dynamics(dynamics, demos, behavior, policy, planner, schedule=short)


def fit_of_network():
    network = eqx.nn.MLP(2, "scalar", 2, 1, jnp.tanh, key=jax.random.key(0))
    return fit_of(ss.FeaturedGrid(GRID, jnp.ones((3, 2)), network))


def plain_values():
    return [
        1,
        2.5,
        np.nan,
        -np.inf,
        True,
        None,
        "β",
        (),
        {"a": [np.float32(0.1), np.int8(3)], 2: np.array(["x", "yz"])},
    ]


def settings():
    return ss.Status.MIXED, ss.Cell.FREE, GRID, ss.SolveOptions(solver=ss.GaussSeidel()), ss.Labels(("a",), (1, 2))


def posteriors():
    return {
        "samples": ss.sample_barriers(ss.ObstacleGrid(GRID), shown(), BEHAVIOR, prior=PRIOR),
        "mean field": ss.mean_field_barriers(ss.ObstacleGrid(GRID), shown(), BEHAVIOR, prior=PRIOR),
        "exact": ss.enumerate_barriers(ss.ObstacleGrid(GRID), shown(), BEHAVIOR, PRIOR),
    }


def fit_and_laplace():
    fit = fit_of(ss.ObstacleGrid(GRID))
    return fit, ss.laplace(fit), ss.information_criteria(fit), ss.pointwise_log_likelihood(fit)


@pytest.mark.parametrize("make", [
    fit_and_laplace,
    fit_of_network,
    posteriors,
    pytest.param(rollout_fit, marks=pytest.mark.slow),
    settings,
    plain_values,
    lambda: ss.plan(ss.ObstacleGrid(GRID), ss.reach(GRID, 2), BEHAVIOR),
    lambda: ss.hierarchical_mrf(np.full(3, np.nan), (1, 3)),
    lambda: sc.network_field(jax.random.key(0), jnp.zeros(2), jnp.ones(2)),
    lambda: (np.zeros((0, 3)), np.array(5.0), jnp.zeros((), jnp.float32), -0.0, 0.1 + 0.2, 2**70),
], ids=["fit", "network", "samples", "rollouts", "settings", "plain", "plan", "prior", "field", "arrays"])  # fmt: skip
def test_load_of_what_save_wrote_is_the_same_to_the_last_bit(make, tmp_path):
    result = make()
    ss.save(tmp_path / "result", result)
    assert_same(result, ss.load(tmp_path / "result"))


def test_loaded_fit_goes_on_as_the_fit_would(tmp_path):
    fit = fit_of(ss.ObstacleGrid(GRID))
    ss.save(tmp_path / "fit", fit)
    loaded = ss.load(tmp_path / "fit")
    assert loaded.model.graph.successors is loaded.problem.model.graph.successors  # saved once
    assert loaded.learned_behavior == fit.learned_behavior
    assert loaded.summary() == fit.summary()
    assert ss.fit(loaded.model, shown(), loaded.behavior).final == ss.fit(fit.model, shown(), fit.behavior).final


class OwnModel(ss.TransitionModel):
    """A model of one's own, with a function."""

    graph: ss.Graph
    parameters: jax.Array
    link: Any = eqx.field(static=True)

    def probabilities(self):
        closed = self.link(self.parameters)[:, None]
        return jnp.broadcast_to(jnp.stack([1 - closed, closed], axis=-1), self.graph.successors.shape)


def test_load_of_a_model_of_ones_own_needs_a_template(tmp_path):
    fit = fit_of(OwnModel(ss.grid_graph(GRID), jnp.zeros(3), lambda logits: 1 / (1 + jnp.exp(-logits))))
    ss.save(tmp_path / "fit", fit)
    with pytest.raises(InputError, match=r"result\.model': .*OwnModel is not a class of the library"):
        ss.load(tmp_path / "fit")
    with pytest.raises(InputError, match=r"OwnModel is not a class of the library: .*, found ObstacleGrid"):
        ss.load(tmp_path / "fit", template=fit_of(ss.ObstacleGrid(GRID)))
    assert_same(fit, ss.load(tmp_path / "fit", template=fit))


def test_load_of_a_function_needs_a_template(tmp_path):
    ss.save(tmp_path / "functions", {"own": abs})
    with pytest.raises(InputError, match=r"result\['own'\]': builtins.abs cannot be saved: expected template="):
        ss.load(tmp_path / "functions")
    assert ss.load(tmp_path / "functions", template={"own": abs})["own"] is abs


@pytest.mark.parametrize("value", [jax.random.key(0), np.array([object()])], ids=["key", "object"])
def test_save_of_other_arrays_raises_and_writes_nothing(value, tmp_path):
    with pytest.raises(InputError, match=r"save, field 'result\[0\]': expected an array of numbers"):
        ss.save(tmp_path / "result", [value])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("value", [{1, 2}, frozenset((1,)), b"ab", 1 + 2j, Path("map"), object()], ids=type)
def test_save_of_an_object_that_is_no_record_raises_and_writes_nothing(value, tmp_path):
    with pytest.raises(InputError, match=rf"save, field 'result\['own'\]': .*, found {type(value).__name__}$"):
        ss.save(tmp_path / "result", {"own": value})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("value", ["\ud800", 10**5000], ids=["half a pair of surrogates", "5001 digits"])
def test_save_of_what_has_no_text_raises_and_writes_nothing(value, tmp_path):
    for result, place in (([value], r"result\[0\]"), ({value: 1}, "result")):
        with pytest.raises(InputError, match=rf"save, field '{place}': expected texts and numbers that a file can"):
            ss.save(tmp_path / "result", result)
    assert not list(tmp_path.iterdir())


def test_save_of_a_list_in_itself_raises_and_writes_nothing(tmp_path):
    result: list[object] = []
    result.append(result)
    with pytest.raises(InputError, match="save: expected a result that does not hold itself"):
        ss.save(tmp_path / "result", result)
    assert not list(tmp_path.iterdir())


def test_load_of_a_damaged_file_raises(tmp_path):
    path = tmp_path / "result"
    ss.save(path, ss.reach(GRID, 2))
    whole = path.read_bytes()
    for cut in (1, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:cut])
        with pytest.raises(InputError, match="expected a result that `save` has written"):
            ss.load(path)
    flips = 0
    for at in range(0, len(whole), 7):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 64]) + whole[at + 1 :])
        try:
            assert_same(ss.load(path), ss.reach(GRID, 2))  # dates and the like do not matter
        except InputError:
            flips += 1
    assert flips > 50


def rewrite(path, change):
    """Write the description of a result anew, changed."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    description = json.loads(members["description.json"])
    change(description)
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, json.dumps(description) if name == "description.json" else content)


def of_class(name):
    return lambda description: description["result"].update(record=name)


@pytest.mark.parametrize(("change", "message"), [
    (lambda description: description.update(version=2), r"expected version 1 of the format, found 2 \(by sidestep"),
    (lambda description: description.update(format="other"), "expected a sidestep result, found 'other'"),
    (lambda description: description.pop("result"), "the description is damaged"),
    (
        lambda description: description["result"]["fields"].pop("discount"),
        "expected the fields reward, .*outcome_reward of",
    ),
    (lambda description: description["result"]["fields"].update(discount={"jax": 99}), "the description is damaged"),
    (lambda description: description["result"]["fields"].update(discount={"odd": 0}), "the description is damaged"),
    (lambda description: description["result"]["fields"].update(discount=[0]), "the description is damaged"),
    (of_class("subprocess.Popen"), "subprocess.Popen is not a class of the library"),
    (of_class("sidestep.fit"), "expected a record, found sidestep.fit"),
    (of_class("sidestep.InputError"), "expected a record, found sidestep.InputError"),
    (of_class("sidestep.io.saving.load"), "is not a class of the library"),
])  # fmt: skip
def test_load_of_a_changed_description_raises(change, message, tmp_path):
    ss.save(tmp_path / "result", ss.reach(GRID, 2))
    rewrite(tmp_path / "result", change)
    with pytest.raises(InputError, match=rf"result.*: .*{message}"):
        ss.load(tmp_path / "result")


def test_load_of_64_bits_into_32_bits_raises(tmp_path):
    ss.save(tmp_path / "result", [jnp.zeros(2), np.zeros(2)])
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.raises(InputError, match="has 64-bit numbers: expected"):
            ss.load(tmp_path / "result")
    finally:
        jax.config.update("jax_enable_x64", True)


def test_load_of_no_file_raises(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        ss.load(tmp_path / "missing")
