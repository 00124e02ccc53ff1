"""People in continuous worlds: they arrive, keep out of walls that they know, and act on what they believe."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.continuous import gather, simulation
from sidestep.continuous.lattice import Lattice, action_values, tabular, tabular_task
from sidestep.continuous.obstacles import ObstacleMotion, Walls
from sidestep.continuous.physical import Pendulum
from sidestep.continuous.simulation import simulate
from sidestep.continuous.tasks import Hold, reach, stack
from sidestep.errors import ImproperTask, InputError, NotConverged
from sidestep.tabular.backups import Behavior, LogSumExp
from sidestep.tabular.demonstrations import Trajectory
from sidestep.tabular.solve import SolveOptions, solve
from sidestep.tabular.solvers.jacobi import Jacobi

pytestmark = pytest.mark.usefixtures("unoptimised")

KEY = jax.random.key(0)
LOW, HIGH = jnp.zeros(2), jnp.full(2, 6.0)
WALL = Walls(low=jnp.asarray([[2.4, 0.0]]), high=jnp.asarray([[3.6, 4.0]]))
ROOM = ObstacleMotion(WALL, LOW, HIGH, jnp.full(2, 0.05))
SQUARES = Lattice(LOW, HIGH, (13, 13))
WAYS = jnp.asarray([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
GOALS = [reach(goal, 0.8, discount=1.0, step_cost=1.0) for goal in ((5.0, 1.0), (1.0, 1.0))]
RANDOM = np.random.default_rng(0)
COUNT = 1000
STARTS = [RANDOM.uniform([0.2, 0.2], [1.8, 3.0], (COUNT, 2)), RANDOM.uniform([4.0, 0.2], [5.8, 3.0], (COUNT, 2))]
SHARP, SOFT = Behavior(LogSumExp(), 40.0), Behavior(LogSumExp(), 2.0)


def people(mark_visited_free, behavior, tasks=1, starts=STARTS):
    """Walks to the first goals. Always as many and as long, so that this is compiled but once."""
    return simulate(KEY, ROOM, mark_visited_free, GOALS[:tasks], starts[:tasks], WAYS, behavior, SQUARES, 30)


def aims(walks):
    """Where walkers aim, all of their moves together."""
    places = [walk.states[:-1] + np.asarray(WAYS)[walk.actions] for walk in walks]
    return np.clip(np.concatenate(places), LOW, HIGH)


def walled(places):
    return np.asarray(jax.vmap(WALL.inside)(jnp.asarray(places)))


@pytest.fixture(scope="module")
def walks():
    """Around a wall, from either side to the other."""
    return people(ROOM, SHARP, tasks=2)


def test_walkers_start_where_they_are_told_and_arrive(walks):
    assert [walk.task for walk in walks] == [0] * COUNT + [1] * COUNT
    np.testing.assert_array_equal([walk.states[0] for walk in walks], np.concatenate(STARTS))
    for walk in walks:
        goal = np.array([[5, 1], [1, 1]])[walk.task]
        away = np.linalg.norm(walk.states - goal, axis=1)
        assert away[-1] <= 0.8 < away[:-1].min()


def test_walkers_never_aim_into_walls_that_they_know(walks):
    assert not walled(aims(walks)).any()
    ends = np.concatenate([walk.states[1:] for walk in walks])
    np.testing.assert_allclose(ends, aims(walks), atol=0.3)
    assert min(len(walk.actions) for walk in walks) >= 6


def test_walks_are_demonstrations(walks):
    demonstrations = gather(walks, GOALS)
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


def test_walkers_who_believe_in_no_wall_run_into_it():
    misled = people(ObstacleMotion(Walls(low=WALL.low + 90, high=WALL.high + 90), LOW, HIGH, jnp.full(2, 0.05)), SHARP)
    assert len(misled) == COUNT
    assert walled(aims(misled)).mean() > 0.5
    assert np.mean([len(walk.actions) == 30 for walk in misled]) > 0.8


def test_those_who_stand_at_their_goal_do_not_walk():
    starts = np.array(STARTS[0])
    starts[[0, 2]] = [[5.0, 1.2], [5.0, 1.0]]
    walking = people(ROOM, SHARP, starts=[starts])
    np.testing.assert_array_equal([walk.states[0] for walk in walking], np.delete(starts, [0, 2], axis=0))


def test_soft_people_choose_as_often_as_their_values_say():
    """Values of the corners around, by a solve; a move ahead from where the walkers stand."""
    place = np.array([4.2, 4.0])
    walking = people(ROOM, SOFT, starts=[np.tile(place, (COUNT, 1))])
    values = solve(tabular(ROOM, SQUARES, WAYS), tabular_task(GOALS[0], SQUARES, WAYS), SOFT).values
    q = np.asarray(action_values(ROOM, SQUARES, GOALS[0], values, jnp.asarray(place), WAYS))
    odds = np.exp(2 * (q - q.max()))
    found = np.bincount([walk.actions[0] for walk in walking], minlength=4) / COUNT
    np.testing.assert_allclose(found, odds / odds.sum(), atol=0.05)
    assert found.min() < 0.1 < np.sort(found)[1]


def test_a_belief_in_another_gravity_changes_what_people_do():
    """Who takes a pendulum for light pushes less, and so holds it lower; it swings as the real one does."""
    lattice = Lattice(jnp.asarray([-np.pi, -8.0]), jnp.asarray([np.pi, 8.0]), (20, 17), (True, False))
    goal, torques, real = np.pi - 0.4, jnp.linspace(-2, 2, 5)[:, None], Pendulum(10.0)
    task, starts = Hold(jnp.asarray(goal), jnp.asarray(0.9)), RANDOM.normal([goal, 0], 0.1, (8, 2))
    right, light = (
        simulate(KEY, real, Pendulum(gravity), [task], [starts], torques, SHARP, lattice, 30) for gravity in (10.0, 2.0)
    )
    pushes = [np.mean([np.asarray(torques)[walk.actions].mean() for walk in walks]) for walks in (right, light)]
    assert pushes[0] + 0.2 < pushes[1] < 0
    held = [np.mean([walk.states[-10:, 0].mean() for walk in walks]) for walks in (right, light)]
    assert goal < held[0] < held[1] < np.pi
    swung = jax.jit(jax.vmap(lambda *move: real.outcomes(*move).means[0]))
    for walk in light:
        away = walk.states[1:] - swung(walk.states[:-1], torques[walk.actions])
        assert (np.abs(away) < 5 * np.asarray(real.noise)).all()


# Refusals


def test_walkers_start_somewhere():
    with pytest.raises(InputError, match="starts of task 0: expected rows of 2 finite numbers"):
        people(ROOM, SHARP, starts=[np.array([[1.0, np.nan]])])
    with pytest.raises(InputError, match="starts of task 0: expected rows of 2 finite numbers"):
        people(ROOM, SHARP, starts=[np.ones((2, 3))])
    with pytest.raises(InputError, match="'starts': expected as many as tasks, found 0 for 1"):
        people(ROOM, SHARP, starts=[])


def test_people_who_never_want_to_arrive_are_no_examples():
    """At β = 1/2 and four ways to go, every step is worth ln 4/β − 1 > 0 to them."""
    with pytest.raises(ImproperTask, match="never wants to arrive"):
        people(ROOM, Behavior(LogSumExp(), 0.5))


def test_values_that_were_not_found_are_not_acted_on(monkeypatch):
    monkeypatch.setattr(simulation, "solve", partial(solve, options=SolveOptions(solver=Jacobi(max_sweeps=2))))
    with pytest.raises(NotConverged, match=r"values did not converge for task 0: a finer lattice or a smaller β"):
        people(ROOM, SHARP)


ONE = Trajectory(np.zeros((3, 2)), np.array([0, 1]), 0)


@pytest.mark.parametrize(("wrong", "match"), [
    (Trajectory(np.zeros((1, 2)), np.zeros(0, int), 0), "trajectory, row 2: expected moves and one state"),
    (Trajectory(np.zeros((2, 2)), np.array([0, 1]), 0), r"row 2: expected moves and one state of shape \(2,\) more"),
    (Trajectory(np.zeros((3, 3)), np.array([0, 1]), 0), r"row 2: expected .*, found 2 and \(3, 3\)"),
    (Trajectory(np.zeros((3, 2)), np.array([[0.0], [1.0]]), 0), r"field 'actions': expected actions of shape \(\)"),
    (Trajectory(np.full((3, 2), np.inf), np.array([0, 1]), 0), "row 2, field 'states': expected finite numbers"),
    (Trajectory(np.zeros((3, 2)), np.array([0, np.nan]), 0), "row 2, field 'actions': expected finite numbers"),
    (Trajectory(np.zeros((3, 2)), np.array([0, 1]), 2), r"trajectory, row 2: expected a task in 0…1, found 2"),
    (Trajectory(np.zeros((3, 2)), np.array([0, 1]), -1), r"row 2: expected a task in 0…1, found -1"),
])  # fmt: skip
def test_trajectories_that_do_not_fit(wrong, match):
    with pytest.raises(InputError, match=match):
        gather([ONE, wrong], GOALS)


def test_demonstrations_need_trajectories_and_proper_tasks():
    with pytest.raises(InputError, match="field 'trajectories': expected at least one trajectory"):
        gather([], GOALS)
    with pytest.raises(InputError, match="field 'tasks': expected at least one task"):
        gather([ONE], [])
    endless = stack([Hold(goal=jnp.zeros(()), discount=jnp.asarray(0.9))])
    with pytest.raises(InputError, match="field 'discount'"):
        gather([ONE], [Hold(goal=endless.goal[0], discount=jnp.asarray(1.5))])
