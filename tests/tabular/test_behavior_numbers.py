"""What a behavior model is at its parameters: numbers of persons, tasks, and the prior, written out."""

import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.tabular.backups import Behavior, BoltzmannAverage, HardMax
from sidestep.tabular.behavior_model import BehaviorParameters, as_behavior_model, behavior_model
from sidestep.tabular.grid import Grid
from sidestep.tabular.tasks import reach, stack_tasks, task

START = Behavior(BoltzmannAverage(), 3.0, lapse=0.2)
FEATURES = np.random.default_rng(0).normal(size=(4, 2, 3))
WEIGHTS = [0.5, -1.0, 2.0]
AIMED_AT = np.array([[0, 1], [1, 2], [2, 3], [3, 0]])
LEARNED = behavior_model(
    START,
    ["beta", "lapse", "discount"],
    discount=0.7,
    person=[0, 1, 1, 2],
    features=FEATURES,
    reward_weights=WEIGHTS,
    aimed_at=AIMED_AT,
)
CHANGED = LEARNED.with_parameters(
    BehaviorParameters(
        jnp.array([0.1, 0.9, 2.0]),
        jnp.asarray(-1.0),
        jnp.asarray(1.5),
        jnp.array([0.0, 1.0, -2.0]),
        jnp.array([-4.0, -1.0, 0.0, 2.0]),
    )
)


def numbers(learned):
    """What is not None, as an array."""
    assert learned is not None
    return np.asarray(learned)


def logit(p):
    return np.log(p / (1 - p))


def test_behavior_model_starts_at_the_behavior():
    parameters = LEARNED.parameters
    np.testing.assert_allclose(numbers(parameters.log_beta), np.full(3, np.log(3.0)))
    assert float(numbers(parameters.logit_lapse)) == pytest.approx(logit(0.2))
    assert float(numbers(parameters.logit_discount)) == pytest.approx(logit(0.7))
    np.testing.assert_allclose(numbers(parameters.reward_weights), WEIGHTS)
    np.testing.assert_allclose(numbers(parameters.cost_parameters), np.full(4, -4.0))
    without = behavior_model(Behavior(HardMax(), 2.0), ["lapse"])
    assert float(numbers(without.behavior_of().lapse)) == pytest.approx(0.05)
    assert without.parameters.log_beta is None
    assert without.costs is None
    assert numbers(behavior_model(START, ["beta"]).parameters.log_beta).shape == (1,)
    np.testing.assert_array_equal(numbers(behavior_model(START, features=FEATURES).parameters.reward_weights), 0)


def test_behavior_of_a_person_has_its_beta_and_a_typical_one_the_mean_logarithm():
    assert float(CHANGED.behavior_of(1).beta) == pytest.approx(np.exp(0.9))
    assert float(CHANGED.behavior_of(2).beta) == pytest.approx(np.exp(2.0))
    assert float(CHANGED.behavior_of().beta) == pytest.approx(np.exp(1.0))
    assert float(numbers(CHANGED.behavior_of(0).lapse)) == pytest.approx(1 / (1 + np.e))
    assert as_behavior_model(START).behavior_of().beta == START.beta
    assert as_behavior_model(LEARNED) is LEARNED
    for person in (3, -1):
        with pytest.raises(InputError, match=r"expected a person in 0…2"):
            CHANGED.behavior_of(person)


def test_betas_of_tasks_are_those_of_their_persons():
    np.testing.assert_allclose(CHANGED.betas(4), np.exp([0.1, 0.9, 0.9, 2.0]))
    np.testing.assert_allclose(as_behavior_model(START).betas(2), [3.0, 3.0])
    np.testing.assert_allclose(behavior_model(START, ["beta"]).betas(3), [3.0] * 3)


def test_tasks_of_have_features_costs_and_the_discount():
    reward = np.arange(8.0).reshape(4, 2)
    tasks = stack_tasks([task(reward, 0.9, np.eye(4, dtype=bool)[end]) for end in (0, 3)])
    own = CHANGED.tasks_of(tasks)
    costs = np.log1p(np.exp([-4.0, -1.0, 0.0, 2.0]))
    np.testing.assert_allclose(numbers(CHANGED.costs), costs)
    expected = reward + FEATURES @ [0.0, 1.0, -2.0] - costs[AIMED_AT]
    np.testing.assert_allclose(own.reward, np.stack([expected] * 2))
    np.testing.assert_allclose(own.discount, np.full(2, 1 / (1 + np.exp(-1.5))))
    np.testing.assert_array_equal(own.terminal, tasks.terminal)
    same = as_behavior_model(START).tasks_of(tasks)
    np.testing.assert_array_equal(same.reward, tasks.reward)
    np.testing.assert_array_equal(same.discount, tasks.discount)


def test_log_density_is_that_of_independent_normal_numbers():
    """The mean of log β, each person's distance from it, the lapse, discount, weights and costs."""
    b = np.array([0.1, 0.9, 2.0])
    deviations = [
        b.mean() - np.log(3.0),
        *((b - b.mean()) / 0.5),
        -1.0 - logit(0.2),
        1.5 - logit(0.7),
        *(np.array([0.0, 1.0, -2.0]) - WEIGHTS),
        *((np.array([-4.0, -1.0, 0.0, 2.0]) + 4) / 2),
    ]
    assert float(CHANGED.log_density()) == pytest.approx(-0.5 * np.sum(np.square(deviations)))
    assert float(LEARNED.log_density()) == pytest.approx(0, abs=1e-20)
    alone = behavior_model(START, ["beta"])
    moved = alone.with_parameters(alone.parameters._replace(log_beta=jnp.array([np.log(3.0) + 0.4])))
    assert float(moved.log_density()) == pytest.approx(-0.08)


@pytest.mark.parametrize(("settings", "field"), [
    ({"learn": ["sharpness of mind"]}, "learn"),
    ({"learn": ["discount"]}, "discount"),
    ({"learn": ["discount"], "discount": 0.0}, "discount"),
    ({"learn": ["discount"], "discount": 1.0}, "discount"),
    ({"discount": 0.5}, "discount"),
    ({"learn": ["beta"], "discount": 0.5}, "discount"),
    ({"reward_weights": [1.0, 2.0]}, "reward_weights"),
    ({"person": [0, 2]}, "person"),
    ({"person": [1, 2]}, "person"),
    ({"person": [-1, 0]}, "person"),
    ({"person": np.zeros(0, int)}, "person"),
    ({"features": FEATURES[0]}, "features"),
    ({"features": FEATURES, "reward_weights": [1.0]}, "reward_weights"),
    ({"aimed_at": AIMED_AT + 1}, "aimed_at"),
    ({"aimed_at": AIMED_AT - 1}, "aimed_at"),
])  # fmt: skip
def test_behavior_model_of_wrong_numbers_raises(settings, field):
    with pytest.raises(InputError, match=field):
        behavior_model(START, **settings)


def test_tasks_of_one_task_is_one_task():
    grid = Grid(np.zeros((2, 2), dtype=int))
    own = CHANGED.tasks_of(reach(grid.forget(), 3))
    assert own.terminal.shape == (4,)
    assert own.discount.shape == ()
    assert own.reward.shape == (4, 2)
