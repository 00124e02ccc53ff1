"""The likelihood by hand, its terms, and what gives none."""

from contextlib import contextmanager

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.inference.calibration import score_statistics
from sidestep.tabular.backups import Behavior, BoltzmannAverage, HardMax, LogSumExp
from sidestep.tabular.demonstrations import Trajectory, gather
from sidestep.tabular.graph import Graph, graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.likelihood import (
    arrival_log_likelihood,
    arrivals_of,
    log_likelihood,
    log_policies,
    transition_probabilities,
)
from sidestep.tabular.models import ObstacleGrid, TabularModel
from sidestep.tabular.solve import SolveOptions, solve
from sidestep.tabular.tasks import reach, task

# In a corridor of three cells, each blocked with p = 1/4, at γ = 1/2, an agent at 0 chooses left, right, right;
# the first two fail; then right again. With g = γ(1−p)/(1−γp) = 3/7: V = g², g, 1.
G = 3 / 7
WALK = Trajectory(np.array([0, 0, 0, 1, 2]), np.array([2, 3, 3, 3]), 0)
BETA = 2.0


def corridor_likelihood(**kwargs):
    grid = Grid.unknown(1, 3)
    demos = gather([WALK], [reach(grid, 2, discount=0.5)])
    return log_likelihood(ObstacleGrid(grid, -float(np.log(3))), demos, Behavior(HardMax(), BETA), **kwargs)


def actions_by_hand() -> float:
    stay, right = 0.5 * G**2, G**2  # at 0: up, down and left are off the map
    at_0 = np.log(3 * np.exp(BETA * stay) + np.exp(BETA * right))
    left = 0.5 * (0.75 * G**2 + 0.25 * G)
    at_1 = np.log(2 * np.exp(BETA * 0.5 * G) + np.exp(BETA * left) + np.exp(BETA * G))
    return BETA * (stay + 2 * right + G) - 3 * at_0 - at_1


TRANSITIONS = np.log(1) + np.log(1 / 4) + 2 * np.log(3 / 4)


@pytest.mark.parametrize(("terms", "actions", "transitions"), [
    (("actions", "transitions"), actions_by_hand(), TRANSITIONS),
    (("actions",), actions_by_hand(), 0),
    (("transitions",), 0, TRANSITIONS),
])  # fmt: skip
def test_log_likelihood_of_a_corridor_equals_the_value_by_hand(terms, actions, transitions):
    likelihood = corridor_likelihood(terms=terms)
    assert float(likelihood.actions) == pytest.approx(actions, rel=1e-9)
    assert float(likelihood.transitions) == pytest.approx(transitions, rel=1e-12)
    assert float(likelihood.total) == pytest.approx(actions + transitions, rel=1e-9)


def corridor_actions_of(horizon: int) -> float:
    return float(corridor_likelihood(terms=("actions",), options=SolveOptions(horizon=horizon)).actions)


def test_log_likelihood_at_horizon_1_is_that_of_myopic_agents():
    """One action ahead there is only the goal, beside state 1; from state 0 all four actions are worth nothing."""
    right, left, stay = 0.5 * 3 / 4, 0.0, 0.0
    at_1 = np.log(2 * np.exp(BETA * stay) + np.exp(BETA * left) + np.exp(BETA * right))
    assert corridor_actions_of(1) == pytest.approx(BETA * right - at_1 - 3 * np.log(4), rel=1e-12)


def test_log_likelihood_at_horizon_2_equals_the_value_by_hand():
    """After one action the values are 0 at 0, v = γ(1−p) at 1 and 1 at the goal; Q looks one action further."""
    v = 0.5 * 3 / 4
    right, stay = 0.5 * v * 3 / 4, 0.0
    at_0 = np.log(3 * np.exp(BETA * stay) + np.exp(BETA * right))
    stay_1, left_1, right_1 = 0.5 * v, 0.5 * v / 4, 0.5 * (3 / 4 + v / 4)
    at_1 = np.log(2 * np.exp(BETA * stay_1) + np.exp(BETA * left_1) + np.exp(BETA * right_1))
    expected = BETA * (stay + 2 * right + right_1) - 3 * at_0 - at_1
    assert corridor_actions_of(2) == pytest.approx(expected, rel=1e-12)


@pytest.mark.slow
def test_log_likelihood_of_outcomes_with_the_same_state_adds_them_up():
    world = graph(np.array([[[1, 1, 0]], [[0, 0, 1]]]))
    model = TabularModel(world, jnp.log(jnp.asarray([[[0.2, 0.3, 0.5]], [[0.6, 0.3, 0.1]]])))
    demos = gather([Trajectory(np.array([0, 0, 1]), np.array([0, 0]), 0)], [reach(world, 1)])
    likelihood = log_likelihood(model, demos, Behavior(HardMax(), 1.0))
    assert float(likelihood.transitions) == pytest.approx(2 * np.log(0.5), rel=1e-12)
    assert float(likelihood.actions) == 0  # a single action is no choice


def test_log_likelihood_of_several_tasks_uses_the_task_of_each_trajectory():
    grid = Grid.unknown(1, 3)
    tasks = [reach(grid, 0, discount=0.5), reach(grid, 2, discount=0.5)]
    model, behavior = ObstacleGrid(grid, -1.0), Behavior(HardMax(), BETA)
    right = Trajectory(np.array([1, 2]), np.array([3]), 1)
    left = Trajectory(np.array([1, 0]), np.array([2]), 0)
    wrong_way = Trajectory(np.array([1, 2]), np.array([3]), 0)
    alone = [float(log_likelihood(model, gather([each], tasks), behavior).total) for each in (left, right, wrong_way)]
    assert alone[0] == pytest.approx(alone[1], rel=1e-12)
    assert alone[2] < alone[1]
    together = log_likelihood(model, gather([left, wrong_way, right], tasks), behavior)
    assert float(together.total) == pytest.approx(sum(alone), rel=1e-12)


def test_log_likelihood_of_an_impossible_transition_is_minus_infinity():
    grid = Grid.unknown(1, 3)
    demos = gather([Trajectory(np.array([0, 2]), np.array([3]), 0)], [reach(grid, 1)])
    likelihood = log_likelihood(ObstacleGrid(grid), demos, Behavior(HardMax(), 1.0), terms=("transitions",))
    assert likelihood.total == -jnp.inf
    assert arrival_log_likelihood(ObstacleGrid(grid), arrivals_of(demos)) == -jnp.inf


def test_arrivals_of_equal_moves_adds_their_weights():
    """Equal moves of different tasks are one; each counts by its weight, and what fills up counts for nothing."""
    grid = Grid.unknown(1, 3)
    model = ObstacleGrid(grid, jnp.asarray([0.0, -1.0, -2.0]))
    walks = [WALK, Trajectory(np.array([0, 0, 1]), np.array([3, 3]), 1)]
    demos = gather(walks, [reach(grid, 2, discount=0.5), reach(grid, 1)])
    for weights, counts in ((np.ones(6), [1, 2, 2, 1]), (np.array([0.0, 1, 2, 0, 3, 0.5]), [0, 4, 2.5, 0])):
        weighed = eqx.tree_at(lambda demos: demos.weights, demos, jnp.asarray(weights))
        arrivals = arrivals_of(weighed)
        kinds = zip(arrivals.states.tolist(), arrivals.actions.tolist(), arrivals.next_states.tolist(), strict=True)
        assert list(kinds)[:4] == [(0, 2, 0), (0, 3, 0), (0, 3, 1), (1, 3, 2)]
        assert arrivals.counts.tolist() == [*counts, *[0] * 12]
        expected = np.log(transition_probabilities(model, demos)) @ weights
        assert float(arrival_log_likelihood(model, arrivals)) == pytest.approx(expected, rel=1e-12)
        likelihood = log_likelihood(model, weighed, Behavior(HardMax(), BETA), terms=("transitions",))
        assert float(likelihood.transitions) == pytest.approx(expected, rel=1e-12)


@contextmanager
def compilations():
    """The compilations within a block, one entry each."""
    events = []

    def listen(event: str, duration_secs: float, **kwargs: str | int) -> None:
        del duration_secs, kwargs
        events.extend([event] * ("backend_compile" in event))

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield events
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def test_solve_of_other_parameters_and_goals_compiles_once():
    grid = Grid.unknown(3, 7)
    with compilations() as first:
        solve(ObstacleGrid(grid, -1.0), reach(grid, 3), Behavior(HardMax(), BETA))
    with compilations() as again:
        solve(ObstacleGrid(grid, -2.0), reach(grid, 8), Behavior(HardMax(), 2 * BETA))
    assert first
    assert not again


@pytest.mark.slow
def test_likelihoods_of_persons_with_any_number_of_moves_compile_once():
    """Ten persons with 1 to 41 moves towards one to five goals."""
    grid = Grid.unknown(2, 7)
    model, behavior = ObstacleGrid(grid, -1.0), Behavior(BoltzmannAverage(), 5.0)

    def look(moves: int, goals: int) -> tuple[np.ndarray, np.ndarray]:
        walk = np.resize([8, 9], moves + 1), np.resize([3, 2], moves)
        walks = [Trajectory(*walk, goal) for goal in range(goals)]
        demos = gather(walks, [reach(grid, goal) for goal in range(goals)])
        each, scored = np.asarray(log_policies(model, demos, behavior)), score_statistics(model, demos, behavior)
        assert len(each) == len(scored.score) == len(transition_probabilities(model, demos)) == moves * goals
        assert float(log_likelihood(model, demos, behavior).actions) == pytest.approx(each.sum(), rel=1e-12)
        np.testing.assert_allclose(scored.log_policy, each, rtol=1e-12)
        return each, scored.score

    with compilations() as first:
        expected = look(41, 1)
    with compilations() as again:
        for moves, goals in ((1, 1), (2, 5), (3, 2), (7, 3), (11, 5), (12, 4), (18, 1), (29, 2), (33, 1), (41, 1)):
            likelihood = look(moves, goals)
    assert first
    assert not again
    np.testing.assert_array_equal(likelihood, expected)


def test_log_policies_of_one_row_of_available_actions_are_those_of_every_state():
    """The row holds for all states, as the shape says."""
    world = graph([[[1], [0], [1]], [[0], [1], [1]]])
    rows = [Graph(world.successors, world.lengths, jnp.asarray([[True, False, True]] * rows)) for rows in (1, 2)]
    walk = Trajectory(np.array([0, 0, 1]), np.array([0, 2]), task=0, truncated=True)
    shown = gather([walk], [task(np.array([[0.0, 5.0, 1.0], [0.5, 2.0, 0.0]]), 0.9, np.array([False, False]))])
    one, every = (
        log_policies(TabularModel(row, jnp.zeros((2, 3, 1))), shown, Behavior(LogSumExp(), 2.0, lapse=0.1))
        for row in rows
    )
    np.testing.assert_allclose(one, every)


def test_log_likelihood_of_impossible_moves_that_do_not_count_is_that_of_the_others():
    """Action 1 leads into a trap: it has the probability 0 at discount 1."""
    world = graph(np.array([[[1], [2]], [[1], [1]], [[2], [2]]]))
    wanted = task(-np.ones((3, 2)), 1.0, np.arange(3) == 1)
    model, behavior = TabularModel(world, jnp.zeros((3, 2, 1))), Behavior(BoltzmannAverage(), BETA)
    good, bad = (Trajectory(np.array([0, end]), np.array([end - 1]), 0) for end in (1, 2))
    both = gather([good, bad], [wanted])
    assert float(log_likelihood(model, gather([bad], [wanted]), behavior).actions) == -np.inf
    assert float(log_likelihood(model, both, behavior).actions) == -np.inf
    assert float(log_likelihood(model, both.with_only([True, False]), behavior).actions) == 0
    assert float(log_likelihood(model, both.with_only([False, True]), behavior).actions) == -np.inf
