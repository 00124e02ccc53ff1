"""Wrong calls of modules that are being rewritten; their checks are still to come.

Add `*LATER` to the cases of `test_wrong_calls`, or move the rows, as soon as a module has its checks.
"""

# pyright: basic, reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false

import jax.numpy as jnp

from helpers.wrong_calls.small import labeled
from sidestep.continuous import Lattice, reach_region

LATER = [
    *labeled("continuous", [
        ("a radius below 0", lambda: reach_region((0.0, 0.0), -1.0), "radius"),
        ("a goal of text", lambda: reach_region("goal", 1.0), "goal"),
        ("a lattice of one point", lambda: Lattice(jnp.zeros(2), jnp.ones(2), (1, 5)), "points"),
        ("a lattice upside down", lambda: Lattice(jnp.ones(2), jnp.zeros(2), (5, 5)), "high"),
    ]),
]  # fmt: skip
