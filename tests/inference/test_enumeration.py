"""`enumerate_barriers`: beside a sum over all maps with dense transitions and plain value iteration."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.barrier_worlds import COSTLY, RIGHT, all_maps, corridor, exact_model, world
from helpers.problems import dense_obstacles, plain_policy, plain_values
from sidestep.errors import InputError, NotConverged
from sidestep.inference.chain_evidence import PASSING
from sidestep.inference.enumeration import ExactPosterior, enumerate_barriers
from sidestep.inference.mrf import BinaryMRF
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.behavior_model import behavior_model
from sidestep.tabular.demonstrations import Trajectory, gather, split_by_person
from sidestep.tabular.grid import Grid
from sidestep.tabular.likelihood import log_likelihood
from sidestep.tabular.models import ObstacleGrid, road_network, walled_grid
from sidestep.tabular.tasks import reach

BETA, DISCOUNT, LAPSE = 5.0, 0.9, 0.1
GRID = Grid.unknown(2, 2)
TASK = reach(GRID, 3, discount=DISCOUNT)
WALK = Trajectory(np.array([0, 0, 2, 3]), np.array([RIGHT, 1, RIGHT]), task=0)  # a bump, then around
SHOWN = gather([WALK], [TASK])
PRIOR = BinaryMRF(np.array([-0.5, 0.2, -1.0, 0.3]), (2, 2), pairs=0.4, blocks=-0.7, isolated=0.5)
MODEL, BEHAVIOR = ObstacleGrid(GRID), Behavior(BoltzmannAverage(), BETA, LAPSE)


def dense_log_likelihoods(closed):
    """The log-likelihoods of actions and transitions in a map."""
    transitions = dense_obstacles(jnp.where(closed, 1.0, -1.0) * np.log(PASSING[0] / PASSING[1]), 2, 2, 4)
    _, q = plain_values("Boltzmann", transitions, TASK, BETA, 400)
    policy = (1 - LAPSE) * plain_policy(q, BETA) + LAPSE / 4
    s, a, after = WALK.states[:-1], WALK.actions, WALK.states[1:]
    return jnp.stack([jnp.log(policy[s, a]).sum(), jnp.log(transitions[s, a, after]).sum()])


@pytest.mark.parametrize(("tempering", "terms"), [
    (1.0, ("actions", "transitions")),
    (0.5, ("actions", "transitions")),
    (0.5, ("actions",)),
    (1.0, ("transitions",)),
])  # fmt: skip
def test_enumerate_barriers_equals_the_dense_sum(tempering, terms):
    maps, crossed = all_maps(4), np.array([True, False, True, True]) & ("transitions" in terms)
    maps = maps[~(maps & crossed).any(axis=1)]
    parts = np.array(jax.vmap(dense_log_likelihoods)(jnp.asarray(maps)))
    weights = np.array([tempering * ("actions" in terms), float("transitions" in terms)])
    log_weights = parts @ weights + [PRIOR.log_density(each) for each in maps]
    exact = enumerate_barriers(MODEL, SHOWN, BEHAVIOR, PRIOR, tempering=tempering, terms=terms)
    assert isinstance(exact, ExactPosterior)
    assert exact.log_evidence == pytest.approx(np.logaddexp.reduce(log_weights), abs=1e-6)
    expected = np.average(maps, axis=0, weights=np.exp(log_weights - log_weights.max()))
    np.testing.assert_allclose(exact.closed, expected, atol=1e-7)


def test_enumerate_barriers_with_a_learned_behavior_has_its_numbers():
    """Two persons, with a discount that is not the tasks' own."""
    walks = [WALK, WALK._replace(states=np.array([0, 2, 3]), actions=np.array([1, RIGHT]))]
    shown, person = split_by_person(gather(walks, [TASK]), [0, 1])
    agents = behavior_model(BEHAVIOR, ["discount"], discount=0.7, person=person)
    agents = agents.with_parameters(agents.parameters._replace(log_beta=jnp.log(jnp.array([2.0, 9.0]))))
    maps = np.array([[False] * 4, [False, True, False, False]])  # walks crossed the others
    scores = [
        float(log_likelihood(exact_model(MODEL, each), shown, agents).total) + PRIOR.log_density(each) for each in maps
    ]
    exact = enumerate_barriers(MODEL, shown, agents, PRIOR)
    assert exact.log_evidence == pytest.approx(np.logaddexp.reduce(scores), abs=1e-6)
    assert exact.closed[1] == pytest.approx(np.exp(scores[1] - np.logaddexp.reduce(scores)), abs=1e-6)


def test_enumerate_barriers_of_a_choice_after_which_the_task_cannot_end_raises():
    roads = road_network(np.array([[0, 1], [0, 3], [1, 2]]), np.ones(4))
    shown = gather([Trajectory(np.array([0, 3]), np.array([1]), task=0)], [COSTLY.reach(roads.graph, 2)])
    with pytest.raises(InputError, match="'demonstrations': expected actions after which the task can end"):
        enumerate_barriers(roads, shown, Behavior(BoltzmannAverage()), BinaryMRF(np.zeros(4)))


def test_enumerate_barriers_without_likelihood_is_the_prior():
    maps = all_maps(4)
    weights = np.exp([PRIOR.log_density(each) for each in maps])
    exact = enumerate_barriers(MODEL, SHOWN, BEHAVIOR, PRIOR, terms=())
    np.testing.assert_allclose(exact.closed, np.average(maps, axis=0, weights=weights))
    assert exact.log_evidence == pytest.approx(np.log(weights.sum()))


def test_enumerate_barriers_keeps_what_is_known_and_what_walks_crossed():
    exact = enumerate_barriers(*world().problem, world().prior).closed
    assert exact[6] == 1  # the known obstacle
    assert not exact[[0, 3, 4, 8, 9, 10, 11, 15]].any()
    assert ((exact > 0) & (exact < 1))[[1, 2, 5, 12, 13, 14]].all()


def crossing(unknown: int):
    """A corridor with so many cells behind the goal that walks say nothing of."""
    grid = Grid.unknown(1, 2 + unknown)
    shown = gather([Trajectory(np.array([0, 1]), np.array([RIGHT]), task=0)], [reach(grid, 1)])
    return ObstacleGrid(grid), shown, Behavior(BoltzmannAverage()), BinaryMRF(np.zeros(2 + unknown))


def test_enumerate_barriers_of_17_unknown_cells_raises():
    with pytest.raises(InputError, match=r"'model'.*at most 16 unknown.*found 17"):
        enumerate_barriers(*crossing(17))


def test_enumerate_barriers_where_a_map_has_no_values_raises():
    """At a small β the Boltzmann average has no fixed point in some maps that sweeps find."""
    grid = Grid.unknown(2, 3)
    shown = gather([Trajectory(np.array([0, 1]), np.array([RIGHT]), task=0)], [COSTLY.reach(grid, 1)])
    with pytest.raises(NotConverged, match="each of 64 maps"):
        enumerate_barriers(walled_grid(grid), shown, Behavior(BoltzmannAverage(), 2.0), BinaryMRF(np.zeros(7)))


@pytest.mark.slow
def test_enumerate_barriers_of_several_batches_of_maps():
    """Two thousand maps; no walk says anything of eleven cells."""
    exact = enumerate_barriers(*crossing(11), terms=("transitions",))
    np.testing.assert_allclose(exact.closed, np.where(np.arange(13) < 2, 0, 0.5), atol=1e-9)


@pytest.mark.parametrize("prior", [BinaryMRF(np.zeros(3)), BinaryMRF(np.zeros(4), (2, 2))])
def test_enumerate_barriers_with_a_prior_of_another_grid_raises(prior):
    with pytest.raises(InputError, match="'prior'"):
        enumerate_barriers(*corridor().problem, prior)
