"""Chains of barriers: after sweeps, values and likelihoods are still those of the present map."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.barrier_worlds import (
    COSTLY,
    DISCOUNTED,
    KINDS,
    RIGHT,
    BarrierWorld,
    all_maps,
    corridor,
    exact_model,
    world,
)
from sidestep.errors import InputError
from sidestep.inference.chains import BarrierProblem, ChainState, barrier_problem
from sidestep.inference.mrf import BinaryMRF
from sidestep.inference.sampler import run_sweep, start_chains
from sidestep.tabular.backups import Behavior, BoltzmannAverage, HardMax, LogSumExp, Mellowmax
from sidestep.tabular.behavior_model import BehaviorModel, behavior_model
from sidestep.tabular.demonstrations import Demonstrations, Trajectory, gather, split_by_person
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.likelihood import log_likelihood
from sidestep.tabular.models import ObstacleGrid, road_network
from sidestep.tabular.models.barriers import barriers_of
from sidestep.tabular.solve import solve
from sidestep.tabular.tasks import Task, reach, task

LEFT = 2
TOLERANCE = 0.01
"""Of β V, and of log-likelihoods: a few times the change that is passed on (.0007 nats), and a part of large values."""


def sampled_chains(problem: BarrierProblem, sweeps: int, heat: float = 1.0) -> list[ChainState]:
    states = start_chains(problem, sweeps, chains=2, seed=0)
    for number in range(sweeps):
        run_sweep(problem, states, number, heat)
    return states


def problem_of(one: BarrierWorld, behavior: BehaviorModel | None = None, **settings: Any) -> BarrierProblem:
    agents = behavior or behavior_model(one.behavior)
    available = one.model.graph.available
    return barrier_problem(
        barriers_of(one.model), one.demonstrations, agents, one.prior, available=available, **settings
    )


def values_of(one: BarrierWorld, closed: np.ndarray, behaviors: list[Behavior]) -> np.ndarray:
    """The values of each task in a map, by `solve`."""
    model, tasks = exact_model(one.model, closed), one.demonstrations.tasks
    each = [jax.tree.map(lambda leaf, at=at: leaf[at], tasks) for at in range(len(behaviors))]
    return np.stack([solve(model, own, behavior).values for own, behavior in zip(each, behaviors, strict=True)])


SETTINGS = {
    "hard max": ("4 moves", {"backup": HardMax()}),
    "Boltzmann": ("4 moves", {"backup": BoltzmannAverage(), "reward": COSTLY, "beta": 2.0}),
    "log-sum-exp": ("4 moves", {"backup": LogSumExp(), "reward": COSTLY, "beta": 3.0}),
    "mellowmax": ("4 moves", {"backup": Mellowmax()}),
    "a lapse": ("4 moves", {"lapse": 0.1}),
    "8 moves": ("8 moves", {"reward": COSTLY, "beta": 2.0, "lapse": 0.05}),
    "slips": ("slips", {}),
    "borders": ("borders", {"backup": LogSumExp()}),
    "turns": ("turns", {"beta": 1.0}),
}


# the longest of all, where no cache has the native code: three kinds of it (4 and 8 moves, slips)
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:agents of task 0 avoid its goal")  # as log-sum-exp agents do at this β
@pytest.mark.parametrize("name", SETTINGS)
def test_chain_after_sweeps_has_the_values_and_likelihood_of_its_map(name):
    kind, settings = SETTINGS[name]
    one = world(kind, **settings)
    beta = settings.get("beta", 6.0)
    for state in sampled_chains(problem_of(one), sweeps=19):  # the ninth after a solve of all states
        closed = state.chain.closed
        expected = values_of(one, closed, [one.behavior] * 2)
        np.testing.assert_allclose(beta * state.chain.values, beta * expected, atol=TOLERANCE, rtol=1e-3)
        likelihood = log_likelihood(exact_model(one.model, closed), one.demonstrations, one.behavior)
        np.testing.assert_allclose(state.chain.totals, np.array(likelihood), atol=TOLERANCE)
        np.testing.assert_array_equal(state.log_likelihoods[-1], state.chain.totals)
        np.testing.assert_array_equal(state.samples[-1], closed)
        assert state.log_priors[-1] == one.prior.log_density(closed)
        assert 0 < state.accepted.sum() <= 19 * 6


def test_refresh_of_a_chain_makes_values_exact():
    one = world()
    problem = problem_of(one)
    (state, _) = sampled_chains(problem, sweeps=19)
    state.chain.values[:] += np.where(problem.evidence.solved, 0.01, 0.0)
    state.chain.totals[:] = 0
    problem.refresh(state.chain, state.work)
    expected = values_of(one, state.chain.closed, [one.behavior] * 2)
    np.testing.assert_allclose(state.chain.values, expected, atol=1e-4)
    likelihood = log_likelihood(exact_model(one.model, state.chain.closed), one.demonstrations, one.behavior)
    np.testing.assert_allclose(state.chain.totals, np.array(likelihood), atol=1e-3)


def test_chain_of_persons_has_the_beta_of_each():
    one = world()
    shown, person = split_by_person(one.demonstrations, np.array([0, 1, 0]))
    model = behavior_model(one.behavior, ["beta"], person=person)
    betas = np.array([2.0, 9.0])
    model = model.with_parameters(model.parameters._replace(log_beta=jnp.log(betas)))
    split = BarrierWorld(one.model, shown, one.behavior, one.prior)
    (state, _) = sampled_chains(problem_of(split, model), sweeps=9)
    behaviors = [model.behavior_of(int(each)) for each in person]
    assert [float(each.beta) for each in behaviors] == pytest.approx([betas[each] for each in person])
    expected = values_of(split, state.chain.closed, behaviors)
    np.testing.assert_allclose(state.chain.values, expected, atol=TOLERANCE / 2)
    each = [
        log_likelihood(exact_model(one.model, state.chain.closed), only_task(shown, at), behavior).actions
        for at, behavior in enumerate(behaviors)
    ]
    assert state.chain.totals[0] == pytest.approx(float(sum(each)), abs=TOLERANCE)


def only_task(shown: Demonstrations[Task], at: int) -> Demonstrations[Task]:
    return shown.with_only(np.asarray(shown.task)[shown.first_moves()] == at)


def test_chain_tempered_counts_a_part_of_the_actions():
    one = world()
    whole, half = (sampled_chains(problem_of(one, tempering=kappa), 1)[0] for kappa in (1.0, 0.5))
    for state, weight in ((whole, 1.0), (half, 0.5)):
        likelihood = log_likelihood(exact_model(one.model, state.chain.closed), one.demonstrations, one.behavior)
        expected = [weight * float(likelihood.actions), float(likelihood.transitions)]
        np.testing.assert_allclose(state.chain.totals, expected, atol=TOLERANCE)


@pytest.mark.parametrize("terms", [("actions",), ("transitions",)])
def test_chain_of_one_term_has_only_that(terms):
    one = world()
    (state, _) = sampled_chains(problem_of(one, terms=terms), 5)
    model = exact_model(one.model, state.chain.closed)
    expected = log_likelihood(model, one.demonstrations, one.behavior, terms=terms)
    np.testing.assert_allclose(state.chain.totals, np.array(expected), atol=TOLERANCE)


def test_chain_of_a_task_without_an_end_follows_its_values():
    """One walks to where it pays to stay; below discount 1 nothing needs to end."""
    grid = Grid.unknown(2, 3)
    stays = task(np.where(np.arange(6) == 2, 1.0, 0.0), 0.8, np.zeros(6, bool))
    walk = Trajectory(np.array([0, 3, 4, 5, 2]), np.array([1, 3, 3, 0]), task=0)
    prior = BinaryMRF(np.zeros(6), (2, 3))
    one = BarrierWorld(ObstacleGrid(grid), gather([walk], [stays]), Behavior(BoltzmannAverage(), 2.0), prior)
    for state in sampled_chains(problem_of(one, terms=("actions",)), 9, heat=4.0):
        expected = values_of(one, state.chain.closed, [one.behavior])
        np.testing.assert_allclose(state.chain.values, expected, atol=TOLERANCE)


def behind_an_obstacle() -> BarrierWorld:
    """A corridor to the first cell; the last two lie behind a known obstacle, from where no way leads there."""
    grid = Grid(np.array([[-1, -1, -1, 1, -1, -1]]))
    walks = [([1, 0], [LEFT]), ([4, 5, 4, 4], [RIGHT, LEFT, LEFT])]
    shown = [Trajectory(np.array(path), np.array(taken), task=0) for path, taken in walks]
    agents, prior = Behavior(BoltzmannAverage(), 2.0), BinaryMRF(np.zeros(6), (1, 6))
    return BarrierWorld(ObstacleGrid(grid), gather(shown, [COSTLY.reach(grid, 0)]), agents, prior)


def test_chain_of_a_walk_where_the_task_cannot_end_has_the_likelihood_of_its_map():
    one = behind_an_obstacle()
    for state in sampled_chains(problem_of(one), 12):
        expected = values_of(one, state.chain.closed, [one.behavior])
        assert np.isneginf(expected[0, 4:]).all()
        np.testing.assert_allclose(state.chain.values, expected, atol=TOLERANCE)
        likelihood = log_likelihood(exact_model(one.model, state.chain.closed), one.demonstrations, one.behavior)
        np.testing.assert_allclose(state.chain.totals, np.array(likelihood), atol=TOLERANCE)


def to_a_dead_end(lapse: float | None) -> BarrierWorld:
    """Roads from the first: one by another road to the third, which is the goal, the others to dead ends."""
    roads = road_network(np.array([[0, 1], [0, 3], [0, 4], [0, 5], [1, 2]]), np.ones(6))
    shown = gather([Trajectory(np.array([0, 3]), np.array([1]), task=0)], [COSTLY.reach(roads.graph, 2)])
    return BarrierWorld(roads, shown, Behavior(BoltzmannAverage(), 2.0, lapse), BinaryMRF(np.zeros(6)))


def test_chain_of_a_choice_after_which_the_task_cannot_end_needs_a_lapse():
    with pytest.raises(InputError, match="'demonstrations': expected actions after which the task can end"):
        sampled_chains(problem_of(to_a_dead_end(None)), 1)
    one = to_a_dead_end(0.1)
    for state in sampled_chains(problem_of(one), 12):
        likelihood = log_likelihood(exact_model(one.model, state.chain.closed), one.demonstrations, one.behavior)
        np.testing.assert_allclose(state.chain.totals, np.array(likelihood), atol=TOLERANCE)


@pytest.mark.slow
def test_chain_without_evidence_samples_the_prior():
    """Marginals, and how often neighbors are both closed, beside the sum over all maps."""
    prior = BinaryMRF(np.linspace(-1.5, 0.5, 8), (2, 4), lines=0.8, pairs=0.4, blocks=-1.0, isolated=-0.5)
    grid = Grid.unknown(2, 4)
    shown = gather([Trajectory(np.array([0, 1]), np.array([RIGHT]), task=0)], [reach(grid, 1)])
    one = BarrierWorld(ObstacleGrid(grid), shown, Behavior(BoltzmannAverage()), prior)
    states = sampled_chains(problem_of(one, terms=()), sweeps=1500)
    samples = np.concatenate([state.samples[20:] for state in states])
    maps = all_maps(8)
    weights = np.exp([prior.log_density(each) for each in maps])
    for drawn, exact in ((samples, maps), (samples[:, :-1] & samples[:, 1:], maps[:, :-1] & maps[:, 1:])):
        np.testing.assert_allclose(drawn.mean(axis=0), np.average(exact, axis=0, weights=weights), atol=0.04)
    for state in states:
        assert not state.log_likelihoods.any()


@pytest.mark.slow
def test_chain_moves_and_runs_are_as_probable_as_their_reverses():
    """Of two cells mostly one is closed; only moves lead from one to the other, flips and runs would bias them."""
    grid, prior = Grid(np.array([[0, 0, 0], [1, -1, -1]])), BinaryMRF(np.full(6, 6.0), (2, 3), pairs=-12.0)
    prior.field[4] += 12  # the known obstacle is a neighbor of the first
    shown = gather([Trajectory(np.array([0, 1]), np.array([RIGHT]), task=0)], [reach(grid, 1)])
    one = BarrierWorld(ObstacleGrid(grid), shown, Behavior(BoltzmannAverage()), prior)
    states = sampled_chains(problem_of(one, terms=()), sweeps=5000)
    samples = np.concatenate([state.samples[20:, 4:] for state in states])
    assert (samples.sum(axis=1) == 1).mean() > 0.98
    np.testing.assert_allclose(samples.mean(axis=0), 0.5, atol=0.045)


@pytest.mark.parametrize("kind", KINDS)
def test_barrier_problem_leaves_known_and_crossed_barriers_as_they_are(kind):
    one = world(kind)
    problem = problem_of(one)
    barriers = barriers_of(one.model)
    for state in start_chains(problem, sweeps=12, chains=2, seed=0):
        fixed = np.setdiff1d(np.arange(len(barriers.known)), problem.free)
        np.testing.assert_array_equal(state.chain.closed[fixed], barriers.known[fixed] == Cell.OCCUPIED)
    expected = {"borders": {0, 1, 2, 7, 8}, "turns": {0, 4, 5, 6, 8, 9}}.get(kind, {1, 2, 5, 12, 13, 14})
    assert set(problem.free.tolist()) == expected


def test_barrier_problem_of_walks_that_jump_raises():
    one = corridor()
    shown = gather([Trajectory(np.array([0, 2]), np.array([RIGHT]), task=0)], [reach(Grid.unknown(1, 4), 3)])
    jumps = BarrierWorld(one.model, shown, one.behavior, one.prior)
    with pytest.raises(InputError, match=r"demonstrations.*transitions that the model allows"):
        problem_of(jumps)


def test_barrier_problem_of_walks_through_a_known_obstacle_raises():
    grid = Grid(np.array([[-1, 1, -1, -1]]))
    shown = gather([Trajectory(np.array([0, 1, 2]), np.array([RIGHT] * 2), task=0)], [reach(grid, 3)])
    one = corridor()
    through = BarrierWorld(ObstacleGrid(grid), shown, one.behavior, one.prior)
    with pytest.raises(InputError, match="demonstrations"):
        problem_of(through)


def test_start_chains_begin_with_few_and_many_closed_barriers():
    grid, prior = Grid.unknown(20, 20), BinaryMRF(np.zeros(400), (20, 20))
    shown = gather([Trajectory(np.array([0, 1]), np.array([RIGHT]), task=0)], [DISCOUNTED.reach(grid, 1)])
    problem = problem_of(BarrierWorld(ObstacleGrid(grid), shown, Behavior(BoltzmannAverage()), prior))
    fractions = [state.chain.closed.mean() for state in start_chains(problem, sweeps=12, chains=3, seed=0)]
    assert fractions[0] < 0.1 < 0.2 < fractions[1] < 0.4 < fractions[2]
