"""Wrong calls of modules that are being rewritten; their checks are still to come.

Add `*LATER` to the cases of `test_wrong_calls`, or move the rows, as soon as a module has its checks.
"""

# ruff: noqa: E501
# pyright: basic, reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false

from types import SimpleNamespace

import jax.numpy as jnp

import sidestep as ss
from helpers.wrong_calls.small import INF, labeled
from sidestep.continuous import Lattice, reach_region


def table(transitions):
    """An environment of Gymnasium with a table of transitions."""
    env = SimpleNamespace(P=transitions)
    env.unwrapped = env
    return env


LOOP = {0: [(1.0, 1, 0.0, True)]}
LATER = [
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
        ("a radius below 0", lambda: reach_region((0.0, 0.0), -1.0), "radius"),
        ("a goal of text", lambda: reach_region("goal", 1.0), "goal"),
        ("a lattice of one point", lambda: Lattice(jnp.zeros(2), jnp.ones(2), (1, 5)), "points"),
        ("a lattice upside down", lambda: Lattice(jnp.ones(2), jnp.zeros(2), (5, 5)), "high"),
    ]),
]  # fmt: skip
