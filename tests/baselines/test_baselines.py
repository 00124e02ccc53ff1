"""Baselines on small maps where the correct result is known."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.baselines import BASELINES, METHODS
from sidestep.baselines.behavior_aware import behavior_aware, transitions_only, visit_counts
from sidestep.baselines.behavior_cloning import behavior_cloning
from sidestep.baselines.constraint_inference import constraint_inference
from sidestep.baselines.interface import BaselineResult, model_result, with_normal_prior
from sidestep.baselines.maxent_irl import CostlyReward, joint_estimation, maxent_irl
from sidestep.evaluation.study import mean_log_likelihood
from sidestep.maps.config import BehaviorConfig, MapConfig, PriorConfig
from sidestep.tabular.backups import Behavior, BoltzmannAverage, LogSumExp
from sidestep.tabular.demonstrations import Trajectory, gather
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.likelihood import log_policies
from sidestep.tabular.models import ObstacleGrid, true_model
from sidestep.tabular.planning import plan
from sidestep.tabular.reward import Reward
from sidestep.tabular.simulation import simulate
from sidestep.tabular.solve import SolveOptions
from sidestep.tabular.tasks import reach, with_state_costs

pytestmark = pytest.mark.slow

WALL = np.zeros((5, 5), int)
WALL[:4, 2] = 1
TRUTH, BLANK = Grid(WALL), Grid.unknown(5, 5)
GOALS = (0, 4, 9, 15)


@pytest.fixture(scope="module")
def walks():
    """Optimal walks around a wall, in both directions."""
    free = np.flatnonzero(WALL.ravel() == 0)
    tasks = [reach(BLANK, goal) for goal in GOALS]
    starts = [np.setdiff1d(free, [goal]) for goal in GOALS]
    return gather(simulate(jax.random.key(0), true_model(TRUTH), tasks, starts), tasks)


@pytest.mark.parametrize("method", [behavior_aware, constraint_inference, joint_estimation])
def test_method_finds_a_wall_that_walks_avoid(method, walks):
    learned = method(BLANK, walks, MapConfig())
    assert learned.ranking[WALL == 1].min() > learned.ranking[WALL == 0].max()
    assert (np.asarray(learned.model.blocked)[WALL == 1] > 0.5).all()
    path = plan(learned.model, learned.reward.reach(BLANK, 4)).path_from(0)
    assert len(path) == 13
    assert not WALL.ravel()[path].any()


@pytest.mark.parametrize(("name", "expected"), [
    ("behavior", True), ("transitions", True), ("visits", False), ("costs", False), ("joint", True), ("cloning", False),
])  # fmt: skip
def test_methods_that_rank_by_probability_say_so(name, expected, walks):
    assert METHODS[name](BLANK, walks, MapConfig()).ranks_by_probability is expected


def test_visit_counts_equals_one_over_visits_plus_one():
    walk = Trajectory(np.array([0, 1, 2, 1, 2, 7]), np.array([3, 3, 2, 3, 1]), 0)
    demos = gather([walk], [reach(BLANK, 7)])
    learned = visit_counts(BLANK, demos, MapConfig())
    blocked = np.asarray(learned.model.blocked).ravel()
    np.testing.assert_allclose(blocked[[0, 1, 2, 7]], [1 / 2, 1 / 3, 1 / 3, 1 / 2])
    np.testing.assert_allclose(np.delete(blocked, [0, 1, 2, 7]), 0.98)
    assert learned.ranking.ravel()[[0, 1, 3]].tolist() == [-1, -2, 0]


def test_transitions_only_leaves_unvisited_cells_at_the_prior(walks):
    blocked = np.asarray(
        transitions_only(BLANK, walks, MapConfig(prior=PriorConfig("normal", wall_prior=0.0))).model.blocked
    )
    prior = 1 / (1 + np.exp(-MapConfig().prior.mean))
    np.testing.assert_allclose(blocked[WALL == 1], prior, atol=1e-4)
    assert blocked[WALL == 0].max() < prior


def test_maxent_irl_explains_detours_by_costs(walks):
    """Costs are highest on the direct path, no move fails, and plans avoid high costs."""
    learned = maxent_irl(BLANK, walks, MapConfig())
    assert np.asarray(learned.model.blocked).max() == 0
    assert learned.ranking[1:4, 2].min() > learned.ranking[WALL == 0].mean()
    path = plan(learned.model, learned.reward.reach(BLANK, 9)).path_from(5)
    assert not WALL.ravel()[path].any()


def test_maxent_irl_reproduces_the_fraction_of_detours():
    """Two equal detours around an obstacle: of a hundred walks forty take the lower one."""
    known = np.array([[0, 0, 0], [0, 1, 0], [0, 0, 0]])
    grid = Grid(known)
    around = Trajectory(np.array([3, 0, 1, 2, 5]), np.array([0, 3, 3, 1]), 0)
    under = Trajectory(np.array([3, 6, 7, 8, 5]), np.array([1, 3, 3, 0]), 0)
    config = MapConfig(behavior=BehaviorConfig(beta=40.0))
    demos = gather([around] * 60 + [under] * 40, [reach(grid, 5)])
    learned = maxent_irl(grid, demos, config)
    task = learned.reward.reach(grid, 5)
    policy = plan(learned.model, task, learned.behavior).policy
    assert float(policy[3, 0] / (policy[3, 0] + policy[3, 1])) == pytest.approx(0.6, abs=0.05)
    assert learned.ranking[2].sum() > learned.ranking[0].sum()
    paid = np.asarray(task.reward - reach(grid, 5).reward)
    np.testing.assert_allclose(paid[3, 0], -learned.ranking[0, 0], rtol=1e-9)


def test_constraint_inference_on_an_empty_map_forbids_nothing():
    tasks = [reach(BLANK, goal) for goal in (0, 24)]
    starts = [np.setdiff1d(np.arange(25), [0, 24, 12])] * 2
    world = ObstacleGrid(BLANK, jnp.full(25, -20.0))
    demos = gather(simulate(jax.random.key(1), world, tasks, starts, Behavior(BoltzmannAverage(), 7.0)), tasks)
    assert np.asarray(constraint_inference(BLANK, demos, MapConfig()).model.blocked).max() < 0.5


def test_joint_estimation_distinguishes_a_costly_floor_from_a_wall():
    """Agents that pay to cross a carpet do so where a detour costs more: it is costly and not blocked."""
    carpet = WALL.astype(float).ravel()
    goals = (*GOALS, 7, 12)
    plain = [reach(BLANK, goal) for goal in goals]
    room = true_model(BLANK.passable())
    costly = [with_state_costs(task, jnp.asarray(0.1 * carpet), room.graph.successors[..., 0]) for task in plain]
    starts = [np.repeat(np.setdiff1d(np.arange(25), [goal]), 4) for goal in goals]
    walks = simulate(jax.random.key(0), room, costly, starts, Behavior(LogSumExp(), 40.0))
    learned = joint_estimation(BLANK, gather(walks, plain), MapConfig(behavior=BehaviorConfig(beta=40.0)))
    assert isinstance(learned.reward, CostlyReward)
    assert learned.reward.costs is not None
    np.testing.assert_allclose(learned.reward.costs[carpet == 1], 0.1, atol=0.03)
    assert learned.reward.costs[carpet == 0].max() < 0.02
    assert learned.ranking.max() < 0.1
    # agents take 4 moves around the carpet rather than 2 across it; robots go across
    path = plan(learned.model, learned.reward.reach(BLANK, 18)).path_from(16)
    assert path.tolist() == [16, 21, 22, 23, 18]
    assert learned.planner.plan_to(18).paths_from(np.array([16]))[0].tolist() == [16, 17, 18]


def walk(*states):
    """Return a walk along a row of cells or, in grids of 5 columns, through neighboring cells."""
    action = {-5: 0, 5: 1, -1: 2, 1: 3}
    return Trajectory(np.array(states), np.array([action[move] for move in np.diff(states).tolist()]), 0)


def test_behavior_cloning_in_a_corridor_repeats_the_demonstration():
    """Other actions have probabilities above 0, and the robot does not enter a known obstacle."""
    corridor = Grid(np.array([[-1, -1, -1, -1, 1]]))
    learned = behavior_cloning(corridor, gather([walk(0, 1, 2, 3)], [reach(corridor, 3)]), MapConfig())
    policy = learned.policy(3)
    assert (policy[:3].argmax(axis=1) == 3).all()
    assert policy[:3, 3].min() > 0.5
    assert policy.min() > 0
    np.testing.assert_allclose(policy.sum(axis=1), 1)
    assert [path.tolist() for path in learned.planner.plan_to(3).paths_from(np.array([0, 2]))] == [[0, 1, 2, 3], [2, 3]]
    assert learned.planner.plan_to(4).paths_from(np.array([3]))[0].tolist() == [3, 2]
    assert learned.planner.goal_mask().tolist() == [[True, True, True, True, False]]


def test_behavior_cloning_in_a_free_room_generalizes_to_new_goals():
    tasks = [reach(BLANK, goal) for goal in (0, 4, 20, 24, 12)]
    starts = [np.setdiff1d(np.arange(25), [goal]) for goal in (0, 4, 20, 24, 12)]
    shown = gather(simulate(jax.random.key(2), true_model(BLANK.passable()), tasks, starts), tasks)
    learned = behavior_cloning(BLANK, shown, MapConfig())
    for goal in (7, 10, 18, 22):
        others = np.delete(np.arange(25), goal)
        shortest = [abs(start // 5 - goal // 5) + abs(start % 5 - goal % 5) for start in others]
        paths = learned.planner.plan_to(goal).paths_from(others)
        assert [path[-1] for path in paths] == [goal] * 24
        assert [len(path) - 1 for path in paths] == shortest


@pytest.mark.parametrize(("logit", "converges"), [(5.0, True), (20.0, False)])
def test_mean_log_likelihood_without_values_is_none(logit, converges, walks):
    """At a logit of 20 a move through the wall succeeds once in 5·10⁸ tries, each at a cost: values do not converge."""
    config = MapConfig(Reward(discount=1.0, step_cost=1.0), BehaviorConfig(beta=0.5))
    walled = ObstacleGrid(BLANK, jnp.where(jnp.arange(25) % 5 == 1, logit, -3.0))
    result = model_result(walled, walks, config)
    mean = mean_log_likelihood(result, walks)
    assert mean == (pytest.approx(float(result.log_policies(walks).mean())) if converges else None)


def test_behavior_cloning_depends_on_the_state():
    """Both goals are four cells to the right: one walk goes straight, the other by another row."""
    straight, around = walk(5, 6, 7, 8, 9), walk(15, 10, 11, 12, 13, 14, 19)._replace(task=1)
    shown = gather([straight, around] * 5, [reach(BLANK, goal) for goal in (9, 19)])
    learned = behavior_cloning(BLANK, shown, MapConfig())
    assert learned.planner.plan_to(9).paths_from(np.array([5]))[0].tolist() == straight.states.tolist()
    assert learned.planner.plan_to(19).paths_from(np.array([15]))[0].tolist() == around.states.tolist()


def test_log_policies_of_agents_with_a_horizon_are_those_of_their_horizon(walks):
    config = MapConfig(behavior=BehaviorConfig(horizon=2))
    result = model_result(true_model(TRUTH), walks, config)
    two, all_ = (
        log_policies(result.model, walks, result.behavior, options=SolveOptions(horizon=horizon))
        for horizon in (2, None)
    )
    assert not np.allclose(two, all_)
    np.testing.assert_allclose(result.log_policies(walks), two)


def test_behavior_cloning_log_policies_equal_its_policy(walks):
    learned = behavior_cloning(BLANK, walks, MapConfig())
    assert learned.ranking is learned.heatmap is None
    each = learned.log_policies(walks)
    for move in (0, 17, len(walks) - 1):
        policy = learned.policy(GOALS[int(walks.task[move])])
        assert each[move] == pytest.approx(np.log(policy[int(walks.states[move]), int(walks.actions[move])]))
    assert each.mean() > np.log(0.5)


@pytest.mark.parametrize(("max_iterations", "converged"), [(1, False), (2000, True)])
def test_behavior_cloning_reports_convergence(walks, max_iterations, converged):
    learned = behavior_cloning(BLANK, walks, MapConfig(), max_iterations)
    assert learned.converged == converged
    assert isinstance(learned, BaselineResult)


def test_methods_begin_with_behavior_aware_modeling():
    assert list(METHODS) == ["behavior", *BASELINES]


def test_constraint_inference_on_a_map_with_known_outer_walls():
    """The corners of the outer walls lead only to themselves."""
    known = np.ones((5, 6), dtype=int)
    known[1:-1, 1:-1] = Cell.UNKNOWN
    demos = gather([Trajectory(np.array([7, 8, 9, 10]), np.array([3, 3, 3]), 0)], [reach(Grid(known), 10)])
    assert np.isfinite(constraint_inference(Grid(known), demos, MapConfig()).ranking).all()


def test_with_normal_prior_keeps_the_agents():
    config = with_normal_prior(MapConfig())
    assert config.prior.kind == "normal"
    assert config.agents == MapConfig().agents


def test_mean_log_likelihood_is_that_of_the_moves_that_count(walks):
    result, weights = model_result(true_model(TRUTH), walks, MapConfig()), np.arange(len(walks)) % 3
    weighted = with_weights(walks, weights)
    repeated = np.repeat(np.asarray(result.log_policies(walks)), weights)
    assert mean_log_likelihood(result, weighted) == pytest.approx(repeated.mean(), rel=1e-9)


def with_weights(shown, weights):
    return eqx.tree_at(lambda each: each.weights, shown, jnp.asarray(weights, float))


@pytest.mark.parametrize("method", [behavior_cloning, constraint_inference])
def test_method_of_weighted_walks_is_that_of_copies(method):
    """With nine walks, each copy is in the fold of its walk."""
    shown, ends = [walk(0, 1, 2, 7), walk(0, 5, 6, 7), walk(2, 1, 6, 7)] * 3, [reach(BLANK, 7)]
    once, counts = gather(shown, ends), [2] * 3 + [1] * 6
    weighted = method(BLANK, with_weights(once, np.repeat(counts, 3)), MapConfig())
    copies = method(BLANK, gather([*shown, *shown[:3]], ends), MapConfig())
    np.testing.assert_allclose(weighted.log_policies(once), copies.log_policies(once), rtol=1e-3)


@pytest.mark.parametrize("method", [visit_counts, constraint_inference])
def test_method_leaves_out_walks_of_weight_zero(method):
    shown, ends = [walk(0, 1, 2, 7), walk(0, 5, 6, 7)], [reach(BLANK, 7)]
    weighted = method(BLANK, with_weights(gather(shown, ends), [1, 1, 1, 0, 0, 0]), MapConfig())
    np.testing.assert_allclose(weighted.ranking, method(BLANK, gather(shown[:1], ends), MapConfig()).ranking)


def test_visit_counts_counts_by_weights():
    walks, ends = [walk(0, 1, 2, 7), walk(0, 5, 6, 7)], [reach(BLANK, 7)]
    weighted = visit_counts(BLANK, with_weights(gather(walks, ends), [2, 2, 2, 1, 1, 1]), MapConfig())
    assert [weighted.ranking.flat[cell] for cell in (0, 1, 5, 7, 8)] == [-3, -2, -1, -3, 0]


def test_constraint_inference_of_agents_with_a_horizon_has_the_policies_of_their_horizon(walks):
    """Agents who look one move ahead see no wall that their goal is behind, so that none explains their walks."""
    learned = [constraint_inference(BLANK, walks, MapConfig(behavior=BehaviorConfig(horizon=far))) for far in (None, 1)]
    assert [int((np.asarray(each.model.blocked) > 0.5).sum()) for each in learned] == [4, 0]
