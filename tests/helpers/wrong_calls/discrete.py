"""Wrong calls of behavior, tasks, graphs, solvers, planning and simulation, and of continuous worlds."""

# ruff: noqa: E501
# pyright: basic, reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false

import jax.numpy as jnp
import numpy as np

import sidestep as ss
from helpers.wrong_calls.small import (
    BEHAVIOR,
    DEMOS,
    GRID,
    KEY,
    MODEL,
    NAN,
    OTHER_MODEL,
    OTHER_TASK,
    TASK,
    WALKS,
    labeled,
)
from sidestep.continuous import Lattice, reach_region

POLICY = jnp.full((20, 4), 0.25)
CASES = [
    *labeled("backups", [
        ("another name", lambda: ss.Behavior("softmax"), "backup"),
        ("the class of another thing", lambda: ss.Behavior(ss.Grid), "backup"),
        ("beta of text", lambda: ss.Behavior(ss.BoltzmannAverage(), beta="7"), "beta"),
        ("beta of an array", lambda: ss.Behavior(ss.BoltzmannAverage(), beta=jnp.ones(3)), "beta"),
        ("beta NaN", lambda: ss.Behavior(ss.BoltzmannAverage(), beta=NAN), "beta"),
        ("beta None", lambda: ss.Behavior(ss.BoltzmannAverage(), beta=None), "beta"),
        ("no backup", lambda: ss.Behavior(None), "backup"),
        ("lapse of text", lambda: ss.Behavior(ss.HardMax(), lapse="0.1"), "lapse"),
        ("lapse of an array", lambda: ss.Behavior(ss.HardMax(), lapse=np.zeros(2)), "lapse"),
        ("lapse 1", lambda: ss.Behavior(ss.HardMax(), lapse=1), "lapse"),
    ]),
    *labeled("tasks", [
        ("a step cost of text", lambda: ss.reach(GRID, 3, step_cost="1"), "step_cost"),
        ("a goal of a fraction", lambda: ss.reach(GRID, 3.5), "goal"),
        ("a goal None", lambda: ss.reach(GRID, None), "goal"),
        ("a discount NaN", lambda: ss.reach(GRID, 3, discount=NAN), "discount"),
        ("a reward of text", lambda: ss.task(np.array(["a", "b"]), 0.9, np.array([False, True])), "reward"),
        ("terminal states by number", lambda: ss.task(np.zeros(2), 0.9, [1]), "terminal"),
        ("a task of another world", lambda: ss.plan(MODEL, ss.task(np.zeros(7), 0.9, np.arange(7) == 3)), "task"),
        ("stack_tasks of two worlds", lambda: ss.stack_tasks([TASK, OTHER_TASK]), "tasks"),
        ("stack_tasks of states", lambda: ss.stack_tasks([3]), "tasks"),
    ]),
    *labeled("graphs", [
        ("graph of floats", lambda: ss.graph(np.array([[[0.5]]])), "successors"),
        ("graph of two axes", lambda: ss.graph(np.zeros((2, 2), int)), "successors"),
        ("graph of text", lambda: ss.graph("graph"), "successors"),
        ("graph, another state", lambda: ss.graph([[[1]]]), "successors"),
    ]),
    *labeled("solve", [
        ("horizon 0", lambda: ss.SolveOptions(horizon=0), "horizon"),
        ("a gradient of a list", lambda: ss.SolveOptions(gradient=["exact"]), "gradient"),
        ("solve, a grid", lambda: ss.solve(GRID, TASK, BEHAVIOR), "model"),
        ("solve, a backup", lambda: ss.solve(MODEL, TASK, ss.HardMax()), "behavior"),
        ("solve, a state", lambda: ss.solve(MODEL, 3, BEHAVIOR), "task"),
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
        ("features of other states", lambda: ss.fit(MODEL, DEMOS, ss.behavior_model(BEHAVIOR, features=np.zeros((7, 4, 1))), optimizer=ss.LBFGS(2)), "rewards of shape"),
        ("weights of other features", lambda: ss.behavior_model(BEHAVIOR, features=np.zeros((1, 4, 1)), reward_weights=[1.0, 2.0]), "reward_weights"),
        ("one name without a tuple", lambda: ss.behavior_model(BEHAVIOR, "beta"), "learn"),
    ]),
    *labeled("continuous", [
        ("a radius below 0", lambda: reach_region((0.0, 0.0), -1.0), "radius"),
        ("a lattice upside down", lambda: Lattice(jnp.ones(2), jnp.zeros(2), (5, 5)), "high"),
    ]),
]  # fmt: skip
