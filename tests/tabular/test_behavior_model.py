"""What is learned of behavior beside the dynamics: β, lapse, discount, reward weights, costs of states."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from sidestep.errors import InputError
from sidestep.inference.fit import fit
from sidestep.inference.objective import Objective, Problem
from sidestep.inference.priors import Normal
from sidestep.tabular.backups import Behavior, BoltzmannAverage, LogSumExp
from sidestep.tabular.behavior_model import LEARNABLE, behavior_model
from sidestep.tabular.demonstrations import Trajectory, gather, split_by_person
from sidestep.tabular.grid import Grid
from sidestep.tabular.likelihood import ALL_TERMS
from sidestep.tabular.models import ObstacleGrid, true_model
from sidestep.tabular.simulation import simulate
from sidestep.tabular.solve import SolveOptions
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import reach, task

pytestmark = pytest.mark.slow

GRID = Grid.unknown(rows=5, columns=6)
OPEN = true_model(GRID.passable())
GOALS = (0, 17, 29)


def tasks_of():
    return [reach(GRID, goal, discount=0.9) for goal in GOALS]


def simulated(behavior, count, seed=0):
    """Agents that cross an open room."""
    starts = np.random.default_rng(seed).integers(GRID.size, size=(len(GOALS), count))
    starts = [own[own != goal] for own, goal in zip(starts, GOALS, strict=True)]
    return simulate(jax.random.key(seed), OPEN, tasks_of(), starts, behavior)


def walks(behavior, count=40):
    return gather(simulated(behavior, count), tasks_of())


def test_log_policy_with_a_lapse_mixes_in_random_actions():
    q = jnp.array([[0.0, 1.0, 3.0]])
    without, lapsing = Behavior(LogSumExp(), 2.0), Behavior(LogSumExp(), 2.0, lapse=0.3)
    mixed = 0.7 * jnp.exp(without.log_policy(q)) + 0.1
    np.testing.assert_allclose(jnp.exp(lapsing.log_policy(q)), mixed, rtol=1e-12)
    np.testing.assert_allclose(Behavior(LogSumExp(), 2.0, lapse=0.0).log_policy(q), without.log_policy(q), rtol=1e-12)


def test_objective_of_all_parameters_has_the_gradient_of_central_differences():
    """By two persons, two features, a lapse, a discount and costs of states."""
    demos = walks(Behavior(BoltzmannAverage(), 8.0, lapse=0.1), count=4)
    features = np.random.default_rng(1).normal(size=(GRID.size, 4, 2))
    behavior = behavior_model(
        Behavior(BoltzmannAverage(), 6.0),
        LEARNABLE,
        discount=0.85,
        person=np.array([0, 1, 1]),
        features=features,
        reward_weights=np.array([0.02, -0.01]),
        aimed_at=np.asarray(OPEN.graph.successors[..., 0]),
    )
    model = ObstacleGrid(GRID, 0.3 * np.sin(np.arange(GRID.size)))
    problem = Problem(model, behavior, demos, Normal(), ALL_TERMS, SolveOptions(solver=Jacobi(tolerance=1e-13)), 0.7)
    objective = Objective(problem)
    point, back = ravel_pytree(problem.parameters)
    starts = objective.cold_starts()
    costs = GRID.size + 2 + 1 + 1 + 2
    assert len(point) == costs + GRID.size
    # away from where the costs' prior is flat
    point = point.at[costs:].add(np.cos(np.arange(GRID.size)))
    result, starts = objective.evaluate(back(point), starts)
    slope = ravel_pytree(result.gradient)[0]
    for index in (3, *range(GRID.size, costs), costs, costs + 8, costs + 29):
        ends = [objective.evaluate(back(point.at[index].add(width)), starts)[0].objective for width in (-1e-5, 1e-5)]
        assert slope[index] == pytest.approx(-(ends[1] - ends[0]) / 2e-5, rel=1e-5, abs=1e-6)


def test_fit_of_beta_and_lapse_in_a_known_room_recovers_them():
    demos = walks(Behavior(BoltzmannAverage(), 60.0, lapse=0.15), count=400)
    result = fit(OPEN, demos, behavior_model(Behavior(BoltzmannAverage(), 30.0), ["beta", "lapse"]))
    assert result.converged
    assert float(result.behavior.behavior_of().beta) == pytest.approx(60, rel=0.15)
    lapse = result.behavior.behavior_of().lapse
    assert lapse is not None
    assert float(lapse) == pytest.approx(0.15, abs=0.03)


def test_fit_of_discount_in_a_known_room_recovers_it():
    agent = Behavior(BoltzmannAverage(), 60.0)
    demos = walks(agent, count=200)
    result = fit(OPEN, demos, behavior_model(agent, ["discount"], discount=0.8))
    np.testing.assert_allclose(result.behavior.tasks_of(demos.tasks).discount, 0.9, atol=0.01)


def test_fit_with_a_person_for_each_trajectory_instead_of_each_task_is_refused():
    agent = Behavior(BoltzmannAverage(), 60.0)
    demos = walks(agent, count=2)
    behavior = behavior_model(agent, person=np.arange(demos.trajectories))
    with pytest.raises(InputError, match=r"field 'person': expected the person of each of the \d tasks \(see split_by"):
        fit(OPEN, demos, behavior)


def test_split_by_person_without_a_number_for_each_trajectory_raises():
    walk = Trajectory(np.array([1, 2]), np.array([3]), task=0)
    with pytest.raises(InputError, match="field 'person': expected whole numbers of shape"):
        split_by_person(gather([walk, walk], tasks_of()), np.asarray([0]))


def test_fit_with_persons_pools_their_betas():
    """Two persons have a hundred walks to each goal; the β of a third, with one walk a goal, is drawn to theirs."""
    trajectories = []
    for beta, count, seed in ((20.0, 100, 0), (6.0, 100, 1), (11.0, 1, 2)):
        trajectories.append(simulated(Behavior(BoltzmannAverage(), beta), count, seed=seed))
    person = np.repeat([0, 1, 2], [len(own) for own in trajectories])
    demos, of_tasks = split_by_person(gather([walk for own in trajectories for walk in own], tasks_of()), person)
    behavior = behavior_model(Behavior(BoltzmannAverage(), 8.0), person=of_tasks)
    result = fit(OPEN, demos, behavior).behavior
    betas = [float(result.behavior_of(person).beta) for person in range(3)]
    assert betas[0] == pytest.approx(20, rel=0.25)
    assert betas[1] == pytest.approx(6, rel=0.25)
    assert betas[1] < betas[2] < betas[0]
    with pytest.raises(InputError, match=r"field 'person': expected a person in 0…2, found 3"):
        result.behavior_of(3)
    assert float(result.behavior_of().beta) == pytest.approx(np.exp(np.mean(np.log(betas))), rel=1e-9)


def test_fit_of_reward_weights_tells_a_disliked_carpet_from_a_wall():
    wall = np.zeros(GRID.shape, dtype=int)
    wall[1:4, 3] = 1
    carpet = np.zeros((GRID.size, 1, 1))
    carpet[[7, 13, 19]] = 1.0
    goals = (5, 12, 29, 0)
    plain, disliked = (
        [task(weight * carpet[..., 0] - 0.05, 1.0, np.arange(GRID.size) == goal) for goal in goals]
        for weight in (0.0, -0.05)
    )
    starts = [np.setdiff1d(np.flatnonzero(wall.ravel() == 0), [goal]) for goal in goals]
    agent = Behavior(LogSumExp(), 40.0)
    demos = simulate(jax.random.key(0), true_model(Grid(wall)), disliked, [np.tile(own, 2) for own in starts], agent)
    result = fit(ObstacleGrid(GRID, -2.0), gather(demos, plain), behavior_model(agent, features=carpet))
    weights = result.behavior.parameters.reward_weights
    assert weights is not None
    assert float(weights[0]) == pytest.approx(-0.05, abs=0.01)
    blocked, hidden = np.asarray(result.model.blocked).ravel(), wall.ravel() == 1
    assert blocked[hidden].min() > blocked[~hidden].max()


def test_tasks_of_with_costs_charges_the_state_that_is_aimed_at():
    """A cost of ln(1 + exp −4) to begin with; k has a standard deviation of 2."""
    aimed_at = np.asarray(OPEN.graph.successors[..., 0])
    behavior = behavior_model(Behavior(LogSumExp(), 5.0), aimed_at=aimed_at)
    assert float(behavior.log_density()) == 0
    assert behavior.costs is not None
    np.testing.assert_allclose(behavior.costs, np.log1p(np.exp(-4)))
    dearer = behavior.with_parameters(behavior.parameters._replace(cost_parameters=jnp.linspace(-4, 0, GRID.size)))
    assert float(dearer.log_density()) == pytest.approx(-np.sum(np.linspace(0, 4, GRID.size) ** 2) / 8)
    paid = dearer.tasks_of(reach(GRID, 0, discount=1.0, step_cost=1.0)).reward
    assert float(paid[7, 3]) == pytest.approx(-1 - np.log1p(np.exp(-4 + 8 * 4 / 29)))  # to the right, at 8
    assert float(paid[29, 3]) == pytest.approx(-1 - np.log(2))  # off the map an action aims at its own state


def test_behavior_model_of_wrong_arguments_raises():
    behavior, features = Behavior(LogSumExp(), 5.0), np.zeros((3, 1, 1))
    refused: list[tuple[dict[str, Any], str]] = [
        ({"learn": ["lapses"]}, r"'learn': expected one of .*'lapses'"),
        ({"learn": ["discount"], "discount": 1.0}, r"'discount': .*above 0 and below 1"),
        ({"person": np.array([0, 2])}, r"'person': expected persons numbered from 0"),
        ({"features": features * np.nan}, r"'features': expected finite numbers"),
        ({"features": features, "reward_weights": np.full(1, np.inf)}, r"'reward_weights': expected finite numbers"),
        ({"aimed_at": np.full((30, 4), 30)}, r"'aimed_at': expected states in 0…29"),
    ]
    for arguments, message in refused:
        with pytest.raises(InputError, match=message):
            behavior_model(behavior, **arguments)
    with pytest.raises(InputError, match=r"'lapse': expected a finite number, at least 0 and below 1"):
        Behavior(LogSumExp(), 5.0, lapse=1.0)
    with pytest.raises(InputError, match=r"'tempering': expected a finite number above 0"):
        fit(OPEN, walks(Behavior(BoltzmannAverage(), 20.0), 2), behavior, tempering=0.0)
