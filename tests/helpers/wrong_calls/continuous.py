"""Wrong calls of continuous worlds: dynamics, tasks, policies, rollouts, lattices and fits."""

# ruff: noqa: E501
# pyright: basic, reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false, reportAbstractUsage=false

from dataclasses import replace
from functools import cache

import jax.numpy as jnp
import numpy as np

import sidestep as ss
import sidestep.continuous as sc
from helpers.wrong_calls.small import DEMOS, INF, KEY, NAN, labeled
from sidestep.tabular.backups import LogSumExp

ONE, TWO = jnp.ones(1), jnp.zeros(2)
BEHAVIOR = ss.Behavior(LogSumExp(), 2.0)
WORLD = sc.LinearGaussian(jnp.eye(1), jnp.eye(1), jnp.full(1, 0.1))
GOAL = sc.reach_region((1.0,), 0.1)
LATTICE = sc.Lattice(-ONE, ONE, (5,))
PAID = replace(ss.reach(ss.Grid.unknown(1, 2), 0), outcome_reward=jnp.ones((1, 1, 1)))
STEPS = jnp.asarray([[-0.5], [0.5]])
AGENT = sc.LatticePlanner(WORLD, STEPS, BEHAVIOR, LATTICE)
WALK = ss.Trajectory(np.array([[0.0], [0.5], [1.0]]), np.array([1, 1]), 0)
PLANNER = sc.Planner(horizon=2)


@cache
def policy() -> sc.FinitePolicy:
    """A policy over two steps."""
    return sc.finite_policy(KEY, STEPS, jnp.eye(3), width=2)


def planned(dynamics=WORLD, states=((0.0,),), task=(0,), planner=PLANNER, **settings):
    """A plan of one step."""
    agent = sc.Agent(dynamics, policy(), settings.pop("behavior", BEHAVIOR))
    tasks = settings.pop("tasks", sc.batch_tasks([GOAL]))
    return sc.plan_policy(agent, tasks, states, task, planner, **{"steps": 1, **settings})


def fitted(dynamics=WORLD, demonstrations=None, behavior=BEHAVIOR, planner=PLANNER, **settings):
    """A fit, which is never made."""
    demonstrations = sc.gather_trajectories([WALK], [GOAL]) if demonstrations is None else demonstrations
    return sc.fit_dynamics(dynamics, demonstrations, behavior, settings.pop("policy", policy()), planner, **settings)


def simulated(agent=AGENT, real=WORLD, tasks=(GOAL,), starts=(((0.0,),),), moves=2, key=KEY):
    """Simulated walks."""
    return sc.simulate_trajectories(key, agent, real, tasks, starts, moves)


def gathered(states, actions=(1, 1), task=0):
    """A walk."""
    return sc.gather_trajectories([ss.Trajectory(states, actions, task)], [GOAL])


CASES = [
    *labeled("dynamics", [
        ("a matrix of text", lambda: sc.LinearGaussian("A", jnp.eye(1), ONE), "state"),
        ("a number for a matrix", lambda: sc.LinearGaussian(1.0, jnp.eye(1), ONE), "state"),
        ("matrices that do not fit", lambda: sc.LinearGaussian(jnp.eye(2), jnp.eye(1), ONE), "as many rows"),
        ("noise 0", lambda: sc.LinearGaussian(jnp.eye(1), jnp.eye(1), jnp.zeros(1)), "noise"),
        ("noise of another width", lambda: sc.LinearGaussian(jnp.eye(1), jnp.eye(1), (0.1, 0.1)), "noise"),
        ("a table for a model", lambda: sc.TableDynamics(np.ones((2, 2))), "model"),
        ("a pendulum without gravity", lambda: sc.Pendulum(0.0), "gravity"),
        ("gravity of text", lambda: sc.Pendulum("9.8"), "gravity"),
        ("an unknown constant", lambda: sc.Pendulum(unknown=("friction",)), "unknown"),
        ("unknown constants without a tuple", lambda: sc.Pendulum(unknown="gravity"), "unknown"),
        ("a pendulum's noise of one number", lambda: sc.Pendulum(noise=0.1), "noise"),
        ("wind NaN", lambda: sc.PointMass(wind=(NAN, 0.0)), "wind"),
        ("wind of text", lambda: sc.PointMass(wind="north"), "wind"),
        ("one center along a side", lambda: sc.radial_field(TWO, TWO + 1, (1, 5)), "counts"),
        ("corners of text", lambda: sc.radial_field("low", TWO + 1, (2, 2)), "low"),
        ("a logit of infinity", lambda: sc.radial_field(TWO, TWO + 1, (2, 2), INF), "logit"),
        ("a seed for a key", lambda: sc.network_field(0, TWO, TWO + 1), "key"),
        ("a width of 0", lambda: sc.network_field(KEY, TWO, TWO + 1, width=0), "width"),
        ("numbers for a field", lambda: sc.ObstacleMotion(np.zeros(3), TWO, TWO + 1, TWO + 1), "field"),
    ]),
    *labeled("continuous tasks", [
        ("a radius below 0", lambda: sc.reach_region((0.0, 0.0), -1.0), "radius"),
        ("a goal of text", lambda: sc.reach_region("goal", 1.0), "goal"),
        ("a goal that is a number", lambda: sc.reach_region(1.0, 1.0), "goal"),
        ("a discount of 2", lambda: sc.reach_region((0.0,), 1.0, discount=2.0), "discount"),
        ("a table of a number", lambda: sc.TableTask(3, None, 7), "index"),
        ("a table for a table", lambda: sc.TableTask(3, [1.0], 0.9), "expected a Task, found 3"),
        ("a table of another number of tasks", lambda: sc.TableTask(DEMOS.tasks, [1.0], 0.9), "task"),
        ("a table with rewards of outcomes", lambda: sc.TableTask(PAID, [1.0], 0.9), "R(s, a, s′)"),
        ("a quadratic discount of 1.7", lambda: sc.QuadraticTask([0.0], [[1.0]], [[1.0]], 1.7), "discount"),
        ("quadratic costs of two dimensions", lambda: sc.QuadraticTask([0.0], jnp.eye(2), [[1.0]], 0.9), "state_cost"),
        ("quadratic costs in a row", lambda: sc.QuadraticTask([0.0], [[1.0]], [[1.0, 1.0]], 0.9), "action_cost"),
        ("quadratic costs of a number", lambda: sc.QuadraticTask([0.0], [[1.0]], 1.0, 0.9), "action_cost"),
        ("a quadratic goal NaN", lambda: sc.QuadraticTask([NAN], [[1.0]], [[1.0]], 0.9), "goal"),
        ("a quadratic goal of a number", lambda: sc.QuadraticTask(0.0, [[1.0]], [[1.0]], 0.9), "goal"),
        ("an angle for two discounts", lambda: sc.PendulumTask(0.0, [0.9, 0.9]), "goal"),
        ("an angle of text", lambda: sc.PendulumTask("up", 0.9), "goal"),
        ("a goal with a radius of 0", lambda: sc.ReachTask([0.0], 0.0, 1.0, 0.0, 0.9), "radius"),
        ("a goal with two costs", lambda: sc.ReachTask([0.0], 1.0, [1.0, 1.0], 0.0, 0.9), "step_cost"),
        ("a task for a list", lambda: sc.batch_tasks(GOAL), "tasks"),
        ("no task", lambda: sc.batch_tasks([]), "tasks"),
        ("tasks of two kinds", lambda: sc.batch_tasks([GOAL, sc.PendulumTask(jnp.zeros(()), jnp.ones(()))]), "kind"),
        ("a tabular task", lambda: sc.batch_tasks([DEMOS.tasks]), "tasks"),
        ("a task of one", lambda: sc.task_at(GOAL, 0), "batch"),
        ("a task that does not exist", lambda: sc.task_at(sc.batch_tasks([GOAL]), 1), "index"),
        ("features of more states than tasks", lambda: sc.task_features(sc.batch_tasks([GOAL]), jnp.zeros((2, 1))), "tasks"),
    ]),
    *labeled("policies", [
        ("one action", lambda: sc.finite_policy(KEY, [[0.0]], jnp.eye(2)), "actions"),
        ("actions of text", lambda: sc.finite_policy(KEY, "up", jnp.eye(2)), "actions"),
        ("no examples", lambda: sc.finite_policy(KEY, STEPS, np.zeros((0, 3))), "examples"),
        ("examples in one row", lambda: sc.finite_policy(KEY, STEPS, np.zeros(3)), "examples"),
        ("a depth below 0", lambda: sc.finite_policy(KEY, STEPS, jnp.eye(2), depth=-1), "depth"),
        ("no inputs", lambda: sc.gaussian_policy(KEY, 0, jnp.eye(2)), "inputs"),
        ("a spread of 0", lambda: sc.gaussian_policy(KEY, 1, jnp.eye(2), spread=0.0), "spread"),
        ("returns of another length", lambda: sc.make_critic(KEY, jnp.eye(2), jnp.ones(2), jnp.ones(3)), "returns"),
        ("more than all of the horizon", lambda: sc.make_critic(KEY, jnp.eye(2), 2 * jnp.ones(2), jnp.ones(2)), "left"),
        ("a backup for a behavior", lambda: sc.Agent(WORLD, policy(), LogSumExp()), "behavior"),
        ("a model for dynamics", lambda: sc.Agent(None, policy(), BEHAVIOR), "dynamics"),
    ]),
    *labeled("rollouts", [
        ("a policy for an agent", lambda: sc.sample_rollout(policy(), GOAL, KEY, ONE, 2), "agent"),
        ("a horizon of 0", lambda: sc.sample_rollout(sc.Agent(WORLD, policy(), BEHAVIOR), GOAL, KEY, ONE, 0), "horizon"),
        ("a tuple for starts", lambda: sc.sample_rollouts(sc.Agent(WORLD, policy(), BEHAVIOR), (ONE,), KEY, 2, 2), "starts"),
        ("numbers for rollouts", lambda: sc.q_estimates(np.zeros(3)), "rollouts"),
        ("returns of numbers", lambda: sc.discounted_returns(np.zeros(3)), "rollouts"),
        ("scores of numbers", lambda: sc.score_surrogate(sc.Agent(WORLD, policy(), BEHAVIOR), np.zeros(3)), "rollouts"),
        ("weights that are numbers", lambda: sc.value_gradient(sc.Agent(WORLD, policy(), BEHAVIOR), sc.Starts(sc.batch_tasks([GOAL]), jnp.zeros((1, 1)), jnp.zeros((1, 2), int)), KEY, jnp.ones(2), horizon=1, samples=1), "weight_function"),
    ]),
    *labeled("plan_policy", [
        ("steps 0", lambda: planned(steps=0), "steps"),
        ("a number for a planner", lambda: planned(planner=20), "planner"),
        ("a task that does not exist", lambda: planned(task=(1,)), "task"),
        ("tasks of floats", lambda: planned(task=(0.0,)), "task"),
        ("a single task", lambda: planned(tasks=GOAL), "batch"),
        ("states of text", lambda: planned(states=("here",)), "states"),
        ("a state NaN", lambda: planned(states=((NAN,),)), "finite"),
        ("a start at the goal", lambda: planned(states=((1.0,),)), "has not ended"),
        ("a policy for a warm start", lambda: planned(warm_start=policy()), "warm_start"),
        ("a report that is none", lambda: planned(report=1), "report"),
    ]),
    *labeled("fit_dynamics", [
        ("a lattice for dynamics", lambda: fitted(LATTICE), "dynamics"),
        ("walks for demonstrations", lambda: fitted(demonstrations=[WALK]), "demonstrations"),
        ("demonstrations in a table", lambda: fitted(demonstrations=DEMOS), "tasks"),
        ("a name for a behavior", lambda: fitted(behavior="softmax"), "behavior"),
        ("a number for a prior", lambda: fitted(prior=1.0), "prior"),
        ("a prior that counts thrice", lambda: fitted(prior=ss.Normal(np.zeros((3, 1, 1)))), "prior mean"),
        ("a number for a schedule", lambda: fitted(schedule=300), "schedule"),
        ("one term without a tuple", lambda: fitted(terms="actions"), "terms"),
        ("no term", lambda: fitted(terms=()), "terms"),
        ("an unknown estimator", lambda: fitted(estimator="exact"), "estimator"),
        ("a seed below 0", lambda: fitted(seed=-1), "seed"),
        ("a seed of text", lambda: fitted(seed="0"), "seed"),
        ("a planner of a lattice", lambda: fitted(planner=AGENT), "planner"),
        ("iterations of 1.5", lambda: sc.Schedule(iterations=1.5), "iterations"),
        ("a tolerance of 0", lambda: sc.Schedule(distance_tolerance=0.0), "distance_tolerance"),
        ("one sample", lambda: sc.Planner(horizon=2, samples=1), "samples"),
        ("a horizon of infinity", lambda: sc.Planner(horizon=INF), "horizon"),
    ]),
    *labeled("lattices", [
        ("a lattice of one point", lambda: sc.Lattice(TWO, TWO + 1, (1, 5)), "points"),
        ("a lattice upside down", lambda: sc.Lattice(TWO + 1, TWO, (5, 5)), "high"),
        ("rings of numbers", lambda: sc.Lattice(TWO, TWO + 1, (5, 5), (0, 1)), "periodic"),
        ("actions of text", lambda: sc.LatticePlanner(WORLD, "up", BEHAVIOR, LATTICE), "actions"),
        ("dynamics without outcomes", lambda: sc.LatticePlanner(AGENT, STEPS, BEHAVIOR, LATTICE), "dynamics"),
        ("a number for a fit", lambda: sc.compare_with_lattice(3, LATTICE), "fit"),
    ]),
    *labeled("continuous walks", [
        ("moves 0", lambda: simulated(moves=0), "moves"),
        ("a seed for a key", lambda: simulated(key=0), "key"),
        ("a behavior for an agent", lambda: simulated(agent=BEHAVIOR), "agent"),
        ("a lattice for a world", lambda: simulated(real=LATTICE), "real"),
        ("starts of too few tasks", lambda: simulated(starts=()), "starts"),
        ("starts of another width", lambda: simulated(starts=(((0.0, 0.0),),)), "starts[0]"),
        ("a task without a list", lambda: simulated(tasks=GOAL), "tasks"),
        ("no walk", lambda: sc.gather_trajectories([], [GOAL]), "trajectories"),
        ("states of text", lambda: gathered(("a", "b", "c")), "states"),
        ("a state too few", lambda: gathered(((0.0,), (0.5,))), "one state of shape"),
        ("a state of infinity", lambda: gathered(((0.0,), (INF,), (1.0,))), "states"),
        ("a task that does not exist", lambda: gathered(((0.0,), (0.5,), (1.0,)), task=1), "task"),
        ("a walk beyond its goal", lambda: gathered(((0.0,), (1.0,), (0.5,))), "terminal"),
    ]),
]  # fmt: skip
