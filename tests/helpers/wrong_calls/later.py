"""Wrong calls of modules that are being rewritten; their checks are still to come.

Add `*LATER` to the cases of `test_wrong_calls`, or move the rows, as soon as a module has its checks.
"""

# ruff: noqa: E501
# pyright: basic, reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np

import sidestep as ss
from helpers.wrong_calls.small import (
    BEHAVIOR,
    DEMOS,
    GRID,
    INF,
    KEY,
    MODEL,
    NAN,
    TASK,
    labeled,
)
from sidestep.continuous import Lattice, reach_region


def table(transitions):
    """An environment of Gymnasium with a table of transitions."""
    env = SimpleNamespace(P=transitions)
    env.unwrapped = env
    return env


LOOP = {0: [(1.0, 1, 0.0, True)]}
GRAPH = ss.graph(np.array([[[0, 1]], [[1, 0]]]))
POLICY = jnp.full((20, 4), 0.25)
LATER = [
    *labeled("backups", [
        ("a tie of text", lambda: ss.HardMax(tie="0"), "tie"),
    ]),
    *labeled("tasks", [
        ("a goal of text", lambda: ss.reach(GRID, ("a", "b")), "goal"),
        ("a goal True", lambda: ss.reach(GRID, True), "goal"),
        ("a discount of text", lambda: ss.reach(GRID, 3, discount="0.9"), "discount"),
        ("reach in a model", lambda: ss.reach(MODEL, 3), "world"),
        ("a reward of three axes", lambda: ss.task(np.zeros((2, 1, 1)), 0.9, np.array([False, True])), "reward"),
        ("stack_tasks of one task", lambda: ss.stack_tasks(TASK), "tasks"),
    ]),
    *labeled("graphs", [
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
        ("horizon of text", lambda: ss.SolveOptions(horizon="2"), "horizon"),
        ("the class of a solver", lambda: ss.SolveOptions(solver=ss.Jacobi), "solver"),
        ("the name of a solver", lambda: ss.SolveOptions(solver="jacobi"), "solver"),
        ("Jacobi, tolerance", lambda: ss.Jacobi(tolerance="0"), "tolerance"),
        ("GaussSeidel, tolerance NaN", lambda: ss.GaussSeidel(tolerance=NAN), "tolerance"),
        ("check_proper, actions", lambda: ss.check_proper(TASK, BEHAVIOR, "4"), "actions"),
    ]),
    *labeled("planning", [
        ("roll_out, no distribution", lambda: ss.roll_out(KEY, MODEL, 2 * POLICY, TASK.terminal, jnp.array([0]), 3), "policy"),
    ]),
    *labeled("behavior_model", [
        ("no person", lambda: ss.behavior_model(BEHAVIOR, person=np.array([], int)), "person"),
        ("persons by name", lambda: ss.behavior_model(BEHAVIOR, person=["anna"]), "person"),
        ("features of two axes", lambda: ss.behavior_model(BEHAVIOR, features=np.zeros((7, 4))), "features"),
        ("a discount of text", lambda: ss.behavior_model(BEHAVIOR, ("discount",), discount="0.9"), "discount"),
        ("a backup", lambda: ss.behavior_model(ss.HardMax()), "behavior"),
    ]),
    *labeled("from_gymnasium", [
        ("no state", lambda: ss.from_gymnasium(table({})), "state"),
        ("a state that is missing", lambda: ss.from_gymnasium(table({0: LOOP, 2: LOOP})), "state"),
        ("probabilities of .3", lambda: ss.from_gymnasium(table({0: {0: [(0.3, 1, 1.0, True)]}, 1: LOOP})), "probabilit"),
        ("an infinite reward", lambda: ss.from_gymnasium(table({0: {0: [(1.0, 0, INF, False)]}, 1: LOOP})), "reward"),
        ("outcomes of two numbers", lambda: ss.from_gymnasium(table({0: {0: [(1.0, 1)]}, 1: LOOP})), "outcome"),
        ("a fraction of a state", lambda: ss.from_gymnasium(table({0: {0: [(1.0, 0.5, 1.0, True)]}, 1: LOOP})), "state"),
        ("a number for a table", lambda: ss.from_gymnasium(table(5)), "P"),
        ("None", lambda: ss.from_gymnasium(None), "env"),
    ]),
    *labeled("continuous", [
        ("a goal of text", lambda: reach_region("goal", 1.0), "goal"),
        ("a lattice of one point", lambda: Lattice(jnp.zeros(2), jnp.ones(2), (1, 5)), "points"),
    ]),
]  # fmt: skip


RIGHT_LATER = {
    "road_network of lists": lambda: ss.road_network([[0, 1]], [1.0, 1.0]).graph.states == 2,
    "road_network of integers": lambda: ss.road_network([[0, 1]], [1, 2], 0).parameters.shape == (2,),
    "TiedModel of a list": lambda: ss.TiedModel(GRAPH, [[[-1, 0]], [[-1, 0]]], [0]).parameters.tolist() == [0],
    "TabularModel of lists": lambda: ss.TabularModel(GRAPH, [[[0, 0]], [[0, 0]]]).parameters.shape == (2, 1, 2),
}
"""Calls that must work then."""
