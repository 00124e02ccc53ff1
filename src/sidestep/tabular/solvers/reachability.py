"""Which states have a finite value at discount 1: those from which some policy surely reaches a terminal state.

Every action costs something there, so a policy that may go on for ever is worth −∞. The states sought are the largest
set F such that from every state of F a terminal state can be reached by *safe* actions: available ones that surely lead
to states of F. It is found by removing states until none is left to remove (almost-sure reachability in Markov decision
processes; de Alfaro, *Formal Verification of Probabilistic Systems*, 1997, section 3; Baier & Katoen, *Principles of
Model Checking*, 2008, section 10.6.1). This differs in one point: a state is in F by probabilities above 0, so what is
in F depends on no size and no precision, only on which outcomes are possible.

Below discount 1 all states have finite values. There is one function for JAX, and one for the host.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from sidestep.tabular.solvers import native
from sidestep.tabular.solvers.base import DecisionProcess


def finite_states(process: DecisionProcess) -> Bool[Array, " states"]:
    """Return whether each state has a finite value; terminal states do."""
    successors, possible = process.successors, process.probabilities > 0
    available = jnp.broadcast_to(process.available, successors.shape[:2])

    def step(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        """Reach one move farther; where that reaches no further state, drop the states that are not reached."""
        finite, reached, _ = state
        safe = available & jnp.all(finite[successors] | ~possible, axis=-1)
        farther = reached | (finite & jnp.any(safe & jnp.any(reached[successors] & possible, axis=-1), axis=-1))
        stopped = jnp.all(farther == reached)
        done = stopped & jnp.all(farther == finite)
        return (
            jnp.where(stopped, farther, finite),
            jnp.where(stopped & ~done, process.terminal, farther),
            ~done,
        )

    start = jnp.ones_like(process.terminal), process.terminal, process.discount >= 1
    return jax.lax.while_loop(lambda state: state[2], step, start)[0]


def finite_states_on_host(
    process: native.HostProcess, order: Int[np.ndarray, " states"]
) -> Bool[np.ndarray, " states"]:
    """Return the same on the host, soonest if the order has nearer states first.

    Args:
        process: The task under a model.
        order: All states.
    """
    finite = np.ones(len(process.terminal), bool)
    if process.discount < 1:
        return finite
    reach = reaching_kernel(*process.successors.shape[1:])
    while True:
        reached = process.terminal.copy()
        reach(order, process.successors, process.probabilities, process.available, finite, reached)
        if (reached == finite).all():
            return finite
        finite = reached


@cache
def reaching_kernel(actions: int, outcomes: int) -> native.NativeFunction:
    """Return native code that extends the reached states, for these numbers of actions and of outcomes."""

    @native.compiled()
    def reach(order, successors, probabilities, available, finite, reached):  # pragma: no cover
        """Mark the states that reach a marked one by safe actions, in passes over an order and back."""
        changed, left = True, 0
        for state in range(len(order)):
            left += finite[state] and not reached[state]
        while changed and left > 0:
            changed = False
            for way in range(2):
                if left == 0:
                    continue
                for index in range(len(order)):
                    state = order[index if way == 0 else len(order) - 1 - index]
                    if reached[state] or not finite[state]:
                        continue
                    for a in range(actions):
                        row, column = state if available.shape[0] > 1 else 0, a if available.shape[1] > 1 else 0
                        safe, arrives = available[row, column], False
                        for k in range(outcomes):
                            if probabilities[state, a, k] > 0:
                                after = successors[state, a, k]
                                safe = safe and finite[after]
                                arrives = arrives or reached[after]
                        if safe and arrives:
                            reached[state] = changed = True
                            left -= 1
                            break

    return reach
