"""Wrong calls of graphs, tasks, models, behavior, solvers, likelihoods, plans and environments."""

# ruff: noqa: E501
# pyright: basic, reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false

from dataclasses import replace
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Discrete

import sidestep as ss
from helpers.wrong_calls.small import (
    BEHAVIOR,
    DEMOS,
    GRID,
    INF,
    KEY,
    MODEL,
    NAN,
    OTHER_MODEL,
    OTHER_TASK,
    TASK,
    WALKS,
    labeled,
)
from sidestep.tabular.forward_gradients import forward_gradient

GRAPH = ss.graph(np.array([[[0, 1]], [[1, 0]]]))
POLICY = jnp.full((20, 4), 0.25)


def changed(**fields):
    """The demonstrations with other fields."""
    return replace(DEMOS, **fields)


def table(transitions):
    """An environment of Gymnasium with a table of transitions."""
    env = SimpleNamespace(P=transitions)
    env.unwrapped = env
    return env


LOOP = {0: [(1.0, 1, 0.0, True)]}
WORLD = ss.from_gymnasium(table({0: LOOP, 1: LOOP}))
ENV = SimpleNamespace(
    reset=lambda **_: (0, {}),
    step=lambda _: (1, 0.0, True, False, {}),
    action_space=Discrete(1),
    observation_space=None,
)
ACT = lambda *_: 0  # noqa: E731
PLAN = ss.plan(MODEL, TASK)
PERSONS = ss.behavior_model(BEHAVIOR, person=[0, 1])
CASES = [
    *labeled("backups", [
        ("beta of text", lambda: ss.Behavior(ss.BoltzmannAverage(), beta="7"), "beta"),
        ("beta of an array", lambda: ss.Behavior(ss.BoltzmannAverage(), beta=jnp.ones(3)), "beta"),
        ("beta NaN", lambda: ss.Behavior(ss.BoltzmannAverage(), beta=NAN), "beta"),
        ("beta None", lambda: ss.Behavior(ss.BoltzmannAverage(), beta=None), "beta"),
        ("an unknown name of a backup", lambda: ss.Behavior("soft"), "backup"),
        ("the class of no backup", lambda: ss.Behavior(int), "backup"),
        ("no backup", lambda: ss.Behavior(None), "backup"),
        ("lapse of text", lambda: ss.Behavior(ss.HardMax(), lapse="0.1"), "lapse"),
        ("lapse of an array", lambda: ss.Behavior(ss.HardMax(), lapse=np.zeros(2)), "lapse"),
        ("lapse 1", lambda: ss.Behavior(ss.HardMax(), lapse=1), "lapse"),
        ("a tie of text", lambda: ss.HardMax(tie="0"), "tie"),
    ]),
    *labeled("tasks", [
        ("a step cost of text", lambda: ss.reach(GRID, 3, step_cost="1"), "step_cost"),
        ("a goal of text", lambda: ss.reach(GRID, ("a", "b")), "goal"),
        ("a goal of a fraction", lambda: ss.reach(GRID, 3.5), "goal"),
        ("a goal True", lambda: ss.reach(GRID, True), "goal"),
        ("a goal None", lambda: ss.reach(GRID, None), "goal"),
        ("a discount of text", lambda: ss.reach(GRID, 3, discount="0.9"), "discount"),
        ("a discount NaN", lambda: ss.reach(GRID, 3, discount=NAN), "discount"),
        ("reach in a model", lambda: ss.reach(MODEL, 3), "world"),
        ("a reward of text", lambda: ss.task(np.array(["a", "b"]), 0.9, np.array([False, True])), "reward"),
        ("a reward of three axes", lambda: ss.task(np.zeros((2, 1, 1)), 0.9, np.array([False, True])), "reward"),
        ("terminal states by number", lambda: ss.task(np.zeros(2), 0.9, [1]), "terminal"),
        ("a task of another world", lambda: ss.plan(MODEL, ss.task(np.zeros(7), 0.9, np.arange(7) == 3)), "task"),
        ("stack_tasks of two worlds", lambda: ss.stack_tasks([TASK, OTHER_TASK]), "tasks"),
        ("stack_tasks of one task", lambda: ss.stack_tasks(TASK), "tasks"),
        ("task_at of one task", lambda: ss.task_at(TASK, 0), "tasks"),
        ("task_at of a state", lambda: ss.task_at(3, 0), "tasks"),
        ("task_at of a task that does not exist", lambda: ss.task_at(ss.stack_tasks([TASK]), 1), "index"),
        ("task_at of half a task", lambda: ss.task_at(ss.stack_tasks([TASK]), 0.5), "index"),
        ("stack_tasks of states", lambda: ss.stack_tasks([3]), "tasks"),
    ]),
    *labeled("graphs", [
        ("graph of floats", lambda: ss.graph(np.array([[[0.5]]])), "successors"),
        ("graph of two axes", lambda: ss.graph(np.zeros((2, 2), int)), "successors"),
        ("graph of text", lambda: ss.graph("graph"), "successors"),
        ("graph, another state", lambda: ss.graph([[[1]]]), "successors"),
        ("grid_graph of an array", lambda: ss.grid_graph(np.zeros((2, 2), int)), "grid"),
        ("road_network of three places", lambda: ss.road_network(np.array([[0, 1, 2]]), np.array([1.0, 1.0, 1.0])), "links"),
        ("road_network, logits", lambda: ss.road_network(np.array([[0, 1]]), np.array([1.0, 1.0]), np.zeros(5)), "logits"),
        ("road_network, a length 0", lambda: ss.road_network([[0, 1]], [0.0]), "lengths"),
        ("road_network, NaN", lambda: ss.road_network([[0, 1]], [NAN]), "lengths"),
        ("road_network, fractions", lambda: ss.road_network([[0.5, 1]], [1.0]), "links"),
        ("closed of a grid", lambda: ss.closed(GRID), "model"),
        ("TabularModel, NaN", lambda: ss.TabularModel(GRAPH, jnp.full((2, 1, 2), NAN)), "logits"),
        ("TabularModel, another shape", lambda: ss.TabularModel(GRAPH, jnp.zeros((2, 2))), "logits"),
        ("TabularModel, numbers for a mask", lambda: ss.TabularModel(GRAPH, jnp.zeros((2, 1, 2)), jnp.ones((2, 1, 2))), "possible"),
        ("TabularModel of an array", lambda: ss.TabularModel(np.zeros((2, 1, 2), int), jnp.zeros((2, 1, 2))), "graph"),
        ("TiedModel, floats", lambda: ss.TiedModel(GRAPH, np.zeros((2, 1, 2))), "index"),
        ("TiedModel, NaN", lambda: ss.TiedModel(GRAPH, np.zeros((2, 1, 2), int), NAN), "logits"),
        ("TiedModel, below IMPOSSIBLE", lambda: ss.TiedModel(GRAPH, np.full((2, 1, 2), -3)), "index"),
        ("with_parameters of another shape", lambda: MODEL.with_parameters(jnp.zeros(3)), "parameters"),
    ]),
    *labeled("solve", [
        ("horizon of a fraction", lambda: ss.fit(MODEL, DEMOS, BEHAVIOR, options=ss.SolveOptions(horizon=2.5)), "horizon"),
        ("horizon 0", lambda: ss.SolveOptions(horizon=0), "horizon"),
        ("horizon of text", lambda: ss.SolveOptions(horizon="2"), "horizon"),
        ("the class of a solver", lambda: ss.SolveOptions(solver=ss.Jacobi), "solver"),
        ("the name of a solver", lambda: ss.SolveOptions(solver="jacobi"), "solver"),
        ("a gradient of a list", lambda: ss.SolveOptions(gradient=["exact"]), "gradient"),
        ("Jacobi, tolerance", lambda: ss.Jacobi(tolerance="0"), "tolerance"),
        ("Jacobi, no sweep", lambda: ss.Jacobi(max_sweeps=0), "max_sweeps"),
        ("GaussSeidel, no sweep", lambda: ss.GaussSeidel(max_sweeps=0), "max_sweeps"),
        ("GaussSeidel, no sweep of a region", lambda: ss.GaussSeidel(max_region_sweeps=0), "max_region_sweeps"),
        ("GaussSeidel, tolerance NaN", lambda: ss.GaussSeidel(tolerance=NAN), "tolerance"),
        ("solve, a grid", lambda: ss.solve(GRID, TASK, BEHAVIOR), "model"),
        ("solve, a backup", lambda: ss.solve(MODEL, TASK, ss.HardMax()), "behavior"),
        ("solve, a state", lambda: ss.solve(MODEL, 3, BEHAVIOR), "task"),
        ("solve, a discount of 1.5", lambda: ss.solve(MODEL, replace(TASK, discount=jnp.asarray(1.5)), BEHAVIOR), "discount"),
        ("plan, a discount of 0", lambda: ss.plan(MODEL, replace(TASK, discount=jnp.asarray(0.0))), "discount"),
        ("plan, a discount NaN", lambda: ss.plan(MODEL, replace(TASK, discount=jnp.asarray(NAN))), "discount"),
        ("log_likelihood, one of two discounts", lambda: ss.log_likelihood(MODEL, changed(tasks=replace(ss.stack_tasks([TASK, TASK]), discount=jnp.array([0.9, 1.1]))), BEHAVIOR), "discount"),
        ("log_likelihood, a single task", lambda: ss.log_likelihood(MODEL, changed(tasks=TASK), BEHAVIOR), "tasks"),
        ("log_likelihood, a task that is not there", lambda: ss.log_likelihood(MODEL, changed(task=jnp.full(6, 5)), BEHAVIOR), "'task'"),
        ("fit, a task -1", lambda: ss.fit(MODEL, changed(task=jnp.full(6, -1)), BEHAVIOR), "'task'"),
        ("log_likelihood, a weight NaN", lambda: ss.log_likelihood(MODEL, changed(weights=jnp.full(6, NAN)), BEHAVIOR), "weights"),
        ("log_likelihood, a weight of infinity", lambda: ss.log_likelihood(MODEL, changed(weights=jnp.full(6, INF)), BEHAVIOR), "weights"),
        ("fit, a weight -1", lambda: ss.fit(MODEL, changed(weights=jnp.full(6, -1.0)), BEHAVIOR), "weights"),
        ("log_likelihood, a move after a terminal state", lambda: ss.log_likelihood(MODEL, changed(states=jnp.array([0, 1, 3, 0, 1, 2])), BEHAVIOR), "move 2, found 3"),
        ("log_likelihood, trajectories in turns", lambda: ss.log_likelihood(MODEL, changed(trajectory=jnp.array([0, 1, 0, 1, 0, 1])), BEHAVIOR), "trajectory"),
        ("log_likelihood, a trajectory left out", lambda: ss.log_likelihood(MODEL, changed(trajectory=jnp.array([0, 0, 0, 2, 2, 2])), BEHAVIOR), "trajectory"),
        ("log_likelihood, trajectories from 1", lambda: ss.log_likelihood(MODEL, changed(trajectory=DEMOS.trajectory + 1), BEHAVIOR), "trajectory"),
        ("log_likelihood, persons of trajectories", lambda: ss.log_likelihood(MODEL, changed(person=jnp.array([0, 1])), BEHAVIOR), "person"),
        ("solve, successors that are no states", lambda: ss.solve(ss.TabularModel(ss.Graph(GRAPH.successors + 1, GRAPH.lengths), jnp.zeros((2, 1, 2))), ss.task(np.zeros(2), 0.9, [False, True]), BEHAVIOR), "successors"),
        ("solve, available actions as 1", lambda: ss.solve(ss.TabularModel(ss.Graph(GRAPH.successors, GRAPH.lengths, jnp.ones((2, 1), int)), jnp.zeros((2, 1, 2))), ss.task(np.zeros(2), 0.9, [False, True]), BEHAVIOR), "available"),
        ("check_proper, actions", lambda: ss.check_proper(TASK, BEHAVIOR, 4), "world"),
        ("log_likelihood, options of text", lambda: ss.log_likelihood(MODEL, DEMOS, BEHAVIOR, options="exact"), "options"),
        ("log_policies, options of a number", lambda: ss.log_policies(MODEL, DEMOS, BEHAVIOR, options=3), "options"),
        ("forward_gradient, options of text", lambda: forward_gradient(MODEL, TASK, BEHAVIOR, options="exact"), "options"),
        ("solve, a start of a number", lambda: ss.solve(MODEL, TASK, BEHAVIOR, start=3), "start"),
        ("solve, a start of values", lambda: ss.solve(MODEL, TASK, BEHAVIOR, start=jnp.zeros(20)), "start"),
        ("log_likelihood of another world", lambda: ss.log_likelihood(OTHER_MODEL, DEMOS, BEHAVIOR), "demonstrations"),
        ("log_likelihood of walks", lambda: ss.log_likelihood(MODEL, WALKS, BEHAVIOR), "demonstrations"),
        ("log_likelihood of a misspelled term", lambda: ss.log_likelihood(MODEL, DEMOS, BEHAVIOR, terms=("action",)), "terms"),
        ("log_policies of another world", lambda: ss.log_policies(OTHER_MODEL, DEMOS, BEHAVIOR), "demonstrations"),
    ]),
    *labeled("planning", [
        ("plan of two tasks", lambda: ss.plan(MODEL, ss.stack_tasks([TASK, TASK])), "task"),
        ("plan of a grid", lambda: ss.plan(GRID, TASK), "model"),
        ("plan of a goal", lambda: ss.plan(MODEL, 3), "task"),
        ("plan with a backup", lambda: ss.plan(MODEL, TASK, ss.HardMax()), "behavior"),
        ("roll_out, another policy", lambda: ss.roll_out(KEY, MODEL, jnp.ones((3, 4)), TASK.terminal, jnp.array([0]), 3), "policy"),
        ("roll_out, no distribution", lambda: ss.roll_out(KEY, MODEL, 2 * POLICY, TASK.terminal, jnp.array([0]), 3), "policy"),
        ("roll_out, a text for a policy", lambda: ss.roll_out(KEY, MODEL, "uniform", TASK.terminal, [0], 3), "policy"),
        ("roll_out, lists of unequal lengths", lambda: ss.roll_out(KEY, MODEL, [[1.0], [0.5, 0.5]], TASK.terminal, [0], 3), "policy"),
        ("roll_out, terminal states as 0 and 1", lambda: ss.roll_out(KEY, MODEL, POLICY, np.zeros(20, int), [0], 3), "booleans"),
        ("roll_out, terminal states as floats", lambda: ss.roll_out(KEY, MODEL, POLICY, jnp.zeros(20), [0], 3), "booleans"),
        ("roll_out, a terminal state by number", lambda: ss.roll_out(KEY, MODEL, POLICY, [3], [0], 3), "terminal"),
        ("roll_out, terminal states of another world", lambda: ss.roll_out(KEY, MODEL, POLICY, [True], [0], 3), "terminal"),
        ("path_from True", lambda: PLAN.path_from(True), "start"),
        ("path_from NumPy's True", lambda: PLAN.path_from(np.True_), "start"),
        ("path_from 1.0", lambda: PLAN.path_from(1.0), "start"),
        ("path_from text", lambda: PLAN.path_from("door"), "start"),
        ("path_from several states", lambda: PLAN.path_from([0, 1]), "start"),
        ("follow from a state that is not there", lambda: PLAN.follow([77]), "starts"),
        ("follow from -1", lambda: PLAN.follow(np.array([-1])), "starts"),
        ("follow from fractions", lambda: PLAN.follow([0.5]), "starts"),
        ("follow from one state", lambda: PLAN.follow(3), "starts"),
        ("plan, options of text", lambda: ss.plan(MODEL, TASK, options="exact"), "options"),
        ("simulate, options of text", lambda: ss.simulate(KEY, MODEL, [TASK], [[0]], options="exact"), "options"),
        ("simulate, no options", lambda: ss.simulate(KEY, MODEL, [TASK], [[0]], options={}), "options"),
        ("roll_out, a state that is not there", lambda: ss.roll_out(KEY, MODEL, POLICY, TASK.terminal, jnp.array([99]), 3), "starts"),
        ("roll_out, moves", lambda: ss.roll_out(KEY, MODEL, POLICY, TASK.terminal, jnp.array([0]), 2.5), "max_moves"),
        ("roll_out, a seed", lambda: ss.roll_out(0, MODEL, POLICY, TASK.terminal, jnp.array([0]), 3), "key"),
        ("simulate, a state that is not there", lambda: ss.simulate(KEY, MODEL, [TASK], [np.array([999])]), "starts"),
        ("simulate, fractions", lambda: ss.simulate(KEY, MODEL, [TASK], [np.array([0.5])]), "starts"),
        ("simulate, a seed", lambda: ss.simulate(0, MODEL, [TASK], [np.array([0])]), "key"),
        ("simulate, too few starts", lambda: ss.simulate(KEY, MODEL, [TASK], []), "starts"),
        ("simulate, one task without a list", lambda: ss.simulate(KEY, MODEL, TASK, [np.array([0])]), "tasks"),
        ("simulate, moves", lambda: ss.simulate(KEY, MODEL, [TASK], [np.array([0])], max_moves=-1), "max_moves"),
    ]),
    *labeled("behavior_model", [
        ("no person", lambda: ss.behavior_model(BEHAVIOR, person=np.array([], int)), "person"),
        ("persons by name", lambda: ss.behavior_model(BEHAVIOR, person=["anna"]), "person"),
        ("features of other states", lambda: ss.fit(MODEL, DEMOS, ss.behavior_model(BEHAVIOR, features=np.zeros((7, 4, 1))), optimizer=ss.LBFGS(max_iterations=2)), "features"),
        ("features of two axes", lambda: ss.behavior_model(BEHAVIOR, features=np.zeros((7, 4))), "features"),
        ("weights of other features", lambda: ss.behavior_model(BEHAVIOR, features=np.zeros((1, 4, 1)), reward_weights=[1.0, 2.0]), "reward_weights"),
        ("behavior_of a float", lambda: PERSONS.behavior_of(1.0), "a person"),
        ("behavior_of True", lambda: PERSONS.behavior_of(True), "a person"),
        ("behavior_of a name", lambda: PERSONS.behavior_of("anna"), "a person"),
        ("behavior_of JAX's 7", lambda: PERSONS.behavior_of(jnp.asarray(7)), "0…1, found 7"),
        ("behavior_of NumPy's -1", lambda: PERSONS.behavior_of(np.int64(-1)), "0…1, found -1"),
        ("behavior_of two persons", lambda: PERSONS.behavior_of(jnp.array([0, 1])), "a person"),
        ("behavior_of a person without persons", lambda: ss.behavior_model(BEHAVIOR).behavior_of(jnp.asarray(0)), "person"),
        ("plan, a person of text", lambda: ss.plan(MODEL, TASK, PERSONS, person="0"), "a person"),
        ("one name without a tuple", lambda: ss.behavior_model(BEHAVIOR, "beta"), "learn"),
        ("a discount of text", lambda: ss.behavior_model(BEHAVIOR, ("discount",), discount="0.9"), "discount"),
        ("a backup", lambda: ss.behavior_model(ss.HardMax()), "behavior"),
    ]),
    *labeled("enumerate_env", [
        ("seeds of a number", lambda: ss.enumerate_env(ENV, seeds=5), "seeds"),
        ("seeds of text", lambda: ss.enumerate_env(ENV, seeds="0"), "seeds"),
        ("a fraction as a seed", lambda: ss.enumerate_env(ENV, seeds=[0, 1.9]), "seeds[1]"),
        ("a seed below 0", lambda: ss.enumerate_env(ENV, seeds=[-1]), "seeds[0]"),
        ("no seed of an iterator", lambda: ss.enumerate_env(ENV, seeds=iter(())), "seeds"),
        ("a key of text", lambda: ss.enumerate_env(ENV, key="obs"), "key"),
        ("a key None", lambda: ss.enumerate_env(ENV, key=None), "key"),
        ("get_state of text", lambda: ss.enumerate_env(ENV, get_state="a", set_state=print), "get_state"),
        ("set_state of a number", lambda: ss.enumerate_env(ENV, get_state=str, set_state=3), "set_state"),
        ("samples of a fraction", lambda: ss.enumerate_env(ENV, samples=1.5), "samples"),
        ("limit of text", lambda: ss.enumerate_env(ENV, limit="9"), "limit"),
        ("None", lambda: ss.enumerate_env(None), "env"),
    ]),
    *labeled("collect", [
        ("a seed below 0", lambda: ss.collect(ENV, WORLD, ACT, 1, seed=-1), "seed"),
        ("a seed of a fraction", lambda: ss.collect(ENV, WORLD, ACT, 1, seed=1.5), "seed"),
        ("a seed None", lambda: ss.collect(ENV, WORLD, ACT, 1, seed=None), "seed"),
        ("a task of a fraction", lambda: ss.collect(ENV, WORLD, ACT, 1, task=1.5), "task"),
        ("a task below 0", lambda: ss.collect(ENV, WORLD, ACT, 1, task=-1), "task"),
        ("act of a number", lambda: ss.collect(ENV, WORLD, 3, 1), "act"),
        ("a key of text", lambda: ss.collect(ENV, WORLD, ACT, 1, key="obs"), "key"),
        ("a model for a world", lambda: ss.collect(ENV, WORLD.model, ACT, 1), "world"),
        ("an environment None", lambda: ss.collect(None, WORLD, ACT, 1), "env"),
        ("slippery of None", lambda: ss.slippery(None), "environment"),
        ("slippery of an environment of Gymnasium", lambda: ss.slippery(ENV), "environment"),
        ("slip_of a number", lambda: ss.slip_of(3), "model"),
        ("slip_of a model of 20 parameters", lambda: ss.slip_of(MODEL), "model"),
        ("slip_of a model of two parameters", lambda: ss.slip_of(ss.TiedModel(GRAPH, [[[-1, 0]], [[-1, 1]]])), "one parameter"),
    ]),
    *labeled("from_gymnasium", [
        ("no state", lambda: ss.from_gymnasium(table({})), "state"),
        ("a state that is missing", lambda: ss.from_gymnasium(table({0: LOOP, 2: LOOP})), "state"),
        ("probabilities of .3", lambda: ss.from_gymnasium(table({0: {0: [(0.3, 1, 1.0, True)]}, 1: LOOP})), "probabilit"),
        ("an infinite reward", lambda: ss.from_gymnasium(table({0: {0: [(1.0, 0, INF, False)]}, 1: LOOP})), "reward"),
        ("outcomes of two numbers", lambda: ss.from_gymnasium(table({0: {0: [(1.0, 1)]}, 1: LOOP})), "probability, next state"),
        ("a fraction of a state", lambda: ss.from_gymnasium(table({0: {0: [(1.0, 0.5, 1.0, True)]}, 1: LOOP})), "state"),
        ("a number for a table", lambda: ss.from_gymnasium(table(5)), "P"),
        ("None", lambda: ss.from_gymnasium(None), "env"),
    ]),
]  # fmt: skip


RIGHT = {
    "graph of a list": lambda: ss.graph([[[0]]]).states == 1,
    "road_network of lists": lambda: ss.road_network([[0, 1]], [1.0, 1.0]).graph.states == 2,
    "road_network of integers": lambda: ss.road_network([[0, 1]], [1, 2], 0).parameters.shape == (2,),
    "TiedModel of a list": lambda: ss.TiedModel(GRAPH, [[[-1, 0]], [[-1, 0]]], [0]).parameters.tolist() == [0],
    "TabularModel of lists": lambda: ss.TabularModel(GRAPH, [[[0, 0]], [[0, 0]]]).parameters.shape == (2, 1, 2),
    "Behavior of a class": lambda: isinstance(ss.Behavior(ss.BoltzmannAverage).backup, ss.BoltzmannAverage),
    "Behavior of a name": lambda: isinstance(ss.Behavior("boltzmann").backup, ss.BoltzmannAverage),
    "Behavior of integers": lambda: ss.Behavior(ss.BoltzmannAverage(), 5, 0).beta == 5,
    "task of lists": lambda: ss.task([0, 1], 1, [False, True]).terminal.tolist() == [False, True],
    "reach of NumPy's numbers": lambda: ss.reach(GRID, np.int8(3), discount=1, step_cost=np.int64(1)).discount == 1,
    "simulate from a list": lambda: len(ss.simulate(KEY, MODEL, (TASK,), [[0]], BEHAVIOR)) == 1,
    "roll_out of lists": lambda: (
        ss.roll_out(KEY, MODEL, POLICY.tolist(), [True] * 20, [0], 3).arrived.tolist() == [True]
    ),
    "roll_out of a policy of integers": lambda: (
        ss.roll_out(KEY, MODEL, np.eye(4, dtype=int)[[3] * 20], np.zeros(20, bool), [0], 2).states.shape == (1, 3)
    ),
    "follow from a list": lambda: PLAN.follow([3])[0].tolist() == [3],
    "path_from JAX's number": lambda: PLAN.path_from(jnp.asarray(3)).tolist() == [3],
    "behavior_of JAX's number": lambda: PERSONS.behavior_of(jnp.asarray(1)).beta > 0,
    "enumerate_env with seeds of an iterator": lambda: ss.enumerate_env(ENV, seeds=iter([0, 1])).labels == (0, 1),
    "collect with NumPy's numbers": lambda: (
        ss.collect(ENV, WORLD, ACT, 1, seed=np.int64(1), task=np.int8(2))[0].task == 2
    ),
    "behavior_model of a list": lambda: len(ss.behavior_model(BEHAVIOR, person=[0, 1]).person) == 2,
}
"""Unusual calls that work."""
