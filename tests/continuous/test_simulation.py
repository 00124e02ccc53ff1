"""Simulated agents: they arrive, avoid walls that they know, and act on their beliefs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sidestep as ss
import sidestep.continuous as sc

KEY = jax.random.key(0)
LOW, HIGH = jnp.zeros(2), jnp.full(2, 6.0)
WALL = sc.Walls(low=jnp.asarray([[2.4, 0.0]]), high=jnp.asarray([[3.6, 4.0]]))
ROOM = sc.ObstacleMotion(WALL, LOW, HIGH, jnp.full(2, 0.05))
SQUARES = sc.Lattice(LOW, HIGH, (13, 13))
WAYS = jnp.asarray([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
GOALS = [sc.reach_region(goal, 0.8, discount=1.0, step_cost=1.0) for goal in ((5.0, 1.0), (1.0, 1.0))]
RANDOM = np.random.default_rng(0)
COUNT = 1000
STARTS = [RANDOM.uniform([0.2, 0.2], [1.8, 3.0], (COUNT, 2)), RANDOM.uniform([4.0, 0.2], [5.8, 3.0], (COUNT, 2))]
SHARP, SOFT = ss.Behavior(ss.LogSumExp(), 40.0), ss.Behavior(ss.LogSumExp(), 2.0)


def simulate(believed, behavior, tasks=1, starts=STARTS, options=None):
    """Walks to the first goals; always the same number and length, so that this is compiled once."""
    agent = sc.LatticePlanner(believed, WAYS, behavior, SQUARES)
    return sc.simulate_trajectories(KEY, agent, ROOM, GOALS[:tasks], starts[:tasks], 30, options)


def targets(walks):
    """The targets of all moves."""
    places = [walk.states[:-1] + np.asarray(WAYS)[walk.actions] for walk in walks]
    return np.clip(np.concatenate(places), LOW, HIGH)


def in_wall(places):
    return np.asarray(jax.vmap(WALL.inside)(jnp.asarray(places)))


@pytest.fixture(scope="module")
def walks():
    """Walks around a wall, from either side to the other."""
    return simulate(ROOM, SHARP, tasks=2)


def test_simulate_trajectories_start_as_asked_and_arrive(walks):
    assert [walk.task for walk in walks] == [0] * COUNT + [1] * COUNT
    np.testing.assert_array_equal([walk.states[0] for walk in walks], np.concatenate(STARTS))
    for walk in walks:
        goal = np.array([[5, 1], [1, 1]])[walk.task]
        away = np.linalg.norm(walk.states - goal, axis=1)
        assert away[-1] <= 0.8 < away[:-1].min()


def test_simulate_trajectories_known_wall_is_never_a_target(walks):
    assert not in_wall(targets(walks)).any()
    ends = np.concatenate([walk.states[1:] for walk in walks])
    np.testing.assert_allclose(ends, targets(walks), atol=0.3)
    assert min(len(walk.actions) for walk in walks) >= 6


def test_gather_trajectories_keeps_every_move(walks):
    demonstrations = sc.gather_trajectories(walks, GOALS)
    assert demonstrations.trajectories == 2 * COUNT
    assert len(demonstrations) == sum(len(walk.actions) for walk in walks)
    ends = np.append(np.diff(demonstrations.trajectory) > 0, True)
    states, following = np.asarray(demonstrations.states), np.asarray(demonstrations.next_states)
    np.testing.assert_array_equal(states[1:][~ends[:-1]], following[:-1][~ends[:-1]])
    np.testing.assert_array_equal(following[ends], [walk.states[-1] for walk in walks])
    np.testing.assert_array_equal(states[0], walks[0].states[0])
    np.testing.assert_array_equal(demonstrations.actions, np.concatenate([walk.actions for walk in walks]))
    np.testing.assert_array_equal(demonstrations.task, np.concatenate([[w.task] * len(w.actions) for w in walks]))
    assert demonstrations.tasks.goal.shape == (2, 2)


def test_gather_trajectories_truncated_walks_stay_so():
    """Two moves of one do not lead to a goal that is 0.6 around 3, from 0; they do from 1.5."""
    task = sc.reach_region((3.0,), 0.6, discount=1.0, step_cost=1.0)
    real = sc.ObstacleMotion(
        sc.Walls(low=jnp.ones((1, 1)), high=jnp.ones((1, 1))), jnp.zeros(1), jnp.full(1, 4.0), jnp.full(1, 0.01)
    )
    agent = sc.LatticePlanner(real, jnp.array([[-1.0], [1.0]]), SHARP, sc.Lattice(jnp.zeros(1), jnp.full(1, 4.0), (9,)))
    walks = sc.simulate_trajectories(KEY, agent, real, [task], [np.array([[0.0], [1.5]])], 2)
    assert [walk.truncated for walk in walks] == [True, False]
    moves = sc.gather_trajectories(walks, [task])
    np.testing.assert_array_equal(moves.truncated, np.asarray(moves.trajectory) == 0)


def test_simulate_trajectories_unknown_wall_is_run_into():
    elsewhere = sc.Walls(low=WALL.low + 90, high=WALL.high + 90)
    misled = simulate(sc.ObstacleMotion(elsewhere, LOW, HIGH, jnp.full(2, 0.05)), SHARP)
    assert len(misled) == COUNT
    assert in_wall(targets(misled)).mean() > 0.5
    assert np.mean([len(walk.actions) == 30 for walk in misled]) > 0.8


def test_simulate_trajectories_start_at_goal_gives_none():
    starts = np.array(STARTS[0])
    starts[[0, 2]] = [[5.0, 1.2], [5.0, 1.0]]
    walking = simulate(ROOM, SHARP, starts=[starts])
    np.testing.assert_array_equal([walk.states[0] for walk in walking], np.delete(starts, [0, 2], axis=0))


def test_simulate_trajectories_soft_choices_match_action_values():
    place = np.array([4.2, 4.0])
    walking = simulate(ROOM, SOFT, starts=[np.tile(place, (COUNT, 1))])
    agent = sc.LatticePlanner(ROOM, WAYS, SOFT, SQUARES)
    values = ss.solve(agent.tabular_model(), agent.tabular_task(GOALS[0]), SOFT).values
    q = np.asarray(agent.action_values(GOALS[0], values, jnp.asarray(place)))
    odds = np.exp(2 * (q - q.max()))
    frequencies = np.bincount([walk.actions[0] for walk in walking], minlength=4) / COUNT
    np.testing.assert_allclose(frequencies, odds / odds.sum(), atol=0.05)
    assert frequencies.min() < 0.1 < np.sort(frequencies)[1]


def test_simulate_trajectories_wrong_gravity_changes_actions():
    """Agents that believe in less gravity push less, and hold it lower; it swings as the real one."""
    lattice = sc.Lattice(jnp.asarray([-np.pi, -8.0]), jnp.asarray([np.pi, 8.0]), (20, 17), (True, False))
    goal, torques, real = np.pi - 0.4, jnp.linspace(-2, 2, 5)[:, None], sc.Pendulum(10.0)
    task, starts = sc.PendulumTask(jnp.asarray(goal), jnp.asarray(0.9)), RANDOM.normal([goal, 0], 0.1, (8, 2))
    agents = (sc.LatticePlanner(sc.Pendulum(gravity), torques, SHARP, lattice) for gravity in (10.0, 2.0))
    right, light = (sc.simulate_trajectories(KEY, agent, real, [task], [starts], 30) for agent in agents)
    pushes = [np.mean([np.asarray(torques)[walk.actions].mean() for walk in walks]) for walks in (right, light)]
    assert pushes[0] + 0.2 < pushes[1] < 0
    held = [np.mean([walk.states[-10:, 0].mean() for walk in walks]) for walks in (right, light)]
    assert goal < held[0] < held[1] < np.pi
    swung = jax.jit(jax.vmap(lambda *move: real.outcomes(*move).means[0]))
    for walk in light:
        away = walk.states[1:] - swung(walk.states[:-1], torques[walk.actions])
        assert (np.abs(away) < 5 * np.asarray(real.noise)).all()


# Refusals


def test_simulate_trajectories_bad_starts_are_refused():
    with pytest.raises(ss.InputError, match=r"starts\[0\]': expected finite numbers, found nan"):
        simulate(ROOM, SHARP, starts=[np.array([[1.0, np.nan]])])
    with pytest.raises(ss.InputError, match=r"starts\[0\]': expected numbers of shape \(agents, 2\)"):
        simulate(ROOM, SHARP, starts=[np.ones((2, 3))])
    with pytest.raises(
        ss.InputError, match=r"starts\[1\]': expected places on the lattice from .*, found \[50.0, 1.0\]"
    ):
        simulate(ROOM, SHARP, tasks=2, starts=[np.ones((1, 2)), np.array([[50.0, 1.0]])])
    with pytest.raises(ss.InputError, match="'starts': expected at least 1, found 0"):
        simulate(ROOM, SHARP, starts=[])


def test_simulate_trajectories_improper_task_is_refused():
    """At β = 1/2 and four actions, every step is worth ln 4/β − 1 > 0."""
    with pytest.raises(ss.ImproperTask, match="an endless path is worth more"):
        simulate(ROOM, ss.Behavior(ss.LogSumExp(), 0.5))


def test_simulate_trajectories_values_not_converged_raise():
    options = ss.SolveOptions(solver=ss.Jacobi(max_sweeps=2))
    with pytest.raises(ss.NotConverged, match=r"values did not converge for task 0: a finer lattice or a smaller β"):
        simulate(ROOM, SHARP, options=options)


ONE = ss.Trajectory(np.zeros((3, 2)), np.array([0, 1]), 0)


@pytest.mark.parametrize(("wrong", "match"), [
    (ss.Trajectory(np.zeros((1, 2)), np.zeros(0, int), 0), "trajectory, row 2: expected moves and one state"),
    (ss.Trajectory(np.zeros((2, 2)), np.array([0, 1]), 0), r"row 2: expected moves and one state of shape \(2,\) more"),
    (ss.Trajectory(np.zeros((3, 3)), np.array([0, 1]), 0), r"row 2: expected .*, found 2 and \(3, 3\)"),
    (ss.Trajectory(np.zeros((3, 2)), np.array([[0.0], [1.0]]), 0), r"field 'actions': expected actions of shape \(\)"),
    (ss.Trajectory(np.full((3, 2), np.inf), np.array([0, 1]), 0), "row 2, field 'states': expected finite numbers"),
    (ss.Trajectory(np.zeros((3, 2)), np.array([0, np.nan]), 0), "row 2, field 'actions': expected finite numbers"),
    (ss.Trajectory(np.zeros((3, 2)), np.array([0, 1]), 2), r"trajectory, row 2, field 'task': expected 0…1, found 2"),
    (ss.Trajectory(np.zeros((3, 2)), np.array([0, 1]), -1), r"row 2, field 'task': expected 0…1, found -1"),
])  # fmt: skip
def test_gather_trajectories_inconsistent_trajectory_is_refused(wrong, match):
    with pytest.raises(ss.InputError, match=match):
        sc.gather_trajectories([ONE, wrong], GOALS)


def test_gather_trajectories_without_trajectories_or_proper_tasks_is_refused():
    with pytest.raises(ss.InputError, match="field 'trajectories': expected at least 1, found 0"):
        sc.gather_trajectories([], GOALS)
    with pytest.raises(ss.InputError, match="field 'tasks': expected at least 1"):
        sc.gather_trajectories([ONE], [])
    with pytest.raises(ss.InputError, match="field 'discount'"):
        sc.gather_trajectories([ONE], [sc.PendulumTask(jnp.zeros(()), jnp.asarray(1.5))])
