"""The paper's dynamic program for the gradients of values (eq. 7 with eq. 8, 9 or 10): a reference implementation.

`solve` differentiates values by the adjoint equation, at a cost that does not grow with the number of parameters. This
module computes the same gradients as the paper describes them, by a forward iteration that carries ∂V/∂θ for every
state and every parameter. It costs about as many value solves as there are parameters, so it serves tests,
benchmarks and readers of the paper.

It differs from the paper in one thing: rewards may depend on actions, as everywhere in this library.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from sidestep.errors import check, check_instance
from sidestep.tabular.backups import Behavior
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.solve import Solution, SolveOptions, decision_process, solve
from sidestep.tabular.solvers.base import DecisionProcess
from sidestep.tabular.tasks import Task


class ForwardGradient(NamedTuple):
    """Gradients of the values of one task, with the model's parameters as one flat axis (see `ravel_pytree`).

    Attributes:
        solution: The values V and Q that were differentiated.
        value_gradient: ∂V(s)/∂θ.
        action_value_gradient: ∂Q(s, a)/∂θ.
        sweeps: How many sweeps over all states the iteration took.
        converged: Whether the values and the iteration converged.
    """

    solution: Solution
    value_gradient: Float[Array, "states parameters"]
    action_value_gradient: Float[Array, "states actions parameters"]
    sweeps: Int[Array, ""]
    converged: Bool[Array, ""]


def forward_gradient(
    model: TransitionModel,
    task: Task,
    behavior: Behavior,
    *,
    options: SolveOptions | None = None,
    max_sweeps: int = 5_000,
) -> ForwardGradient:
    """Compute ∂V/∂θ and ∂Q/∂θ of one task by the paper's dynamic program.

    Use `jax.grad` of `solve` or of `log_likelihood` for anything but small examples: this iteration holds an array of
    states × parameters and costs about |θ| times a value solve.

    Args:
        model: The transition model T_θ.
        task: A single task.
        behavior: How the agent values states.
        options: `gradient` is "exact" (eq. 8) or "fixed_policy" (eqs. 9 and 10); `solver` computes the values, and its
            tolerance is also the relative change at which the iteration stops; a horizon is not supported.
        max_sweeps: The number of sweeps after which the iteration gives up.

    Returns:
        The gradients, and whether they converged.

    Raises:
        InputError: If `options` have a horizon.

    Example:
        >>> import sidestep as ss
        >>> grid = ss.Grid.unknown(rows=1, columns=3)  # a corridor; its right end is the goal
        >>> model = ss.ObstacleGrid(grid, -2.0)
        >>> task = ss.reach(grid, 2, discount=0.9)
        >>> result = forward_gradient(model, task, ss.Behavior(ss.HardMax()))
        >>> bool(result.converged), bool(result.value_gradient[0, 1] < 0)  # a more probable obstacle lowers V
        (True, True)

    References:
        "Towards Behavior-Aware Model Learning from Human-Generated Trajectories", eqs. 7 to 10.
    """
    check_instance(options, (SolveOptions, type(None)), "options")
    options = SolveOptions() if options is None else options
    check(options.horizon is None, f"expected no horizon, found {options.horizon}", field="options")
    solver = options.solver_for(behavior.backup, model.graph.states)
    solution = solve(model, task, behavior, options=SolveOptions(solver=solver))
    values = jax.lax.stop_gradient(solution.values)
    parameters, unravel = ravel_pytree(model.parameters)

    def process(parameters: Float[Array, " parameters"]) -> DecisionProcess:
        probabilities = model.with_parameters(unravel(parameters)).probabilities()
        return decision_process(model, probabilities, task)

    def model_term(direction: Float[Array, " parameters"]) -> Float[Array, "states actions"]:
        """γ Σ_s′ V(s′) ∇T_θ(s, a, s′), the second term of eq. 7, in one direction of θ."""
        return jax.jvp(lambda x: process(x).action_values(values), (parameters,), (direction,))[1]

    now = process(parameters)
    backup = behavior.backup
    weigh = backup.weights if options.gradient == "exact" else backup.fixed_policy_weights  # eq. 8, 9, 10
    weights = weigh(now.action_values(values), behavior.beta.astype(values.dtype))
    weights = jnp.where(now.terminal[:, None], 0, weights)
    next_state = now.discount * now.probabilities  # γ T_θ(s, a, s′) of the first term of eq. 7
    own = jax.lax.map(
        lambda index: jnp.sum(weights * model_term(jnp.zeros_like(parameters).at[index].set(1)), axis=-1),
        jnp.arange(len(parameters)),
    ).T

    def sweep(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        old, _, sweeps = state
        new = own
        for action, outcome in np.ndindex(*next_state.shape[1:]):
            weight = weights[:, action] * next_state[:, action, outcome]
            new = new + weight[:, None] * old[now.successors[:, action, outcome]]
        return new, jnp.abs(new - old).max() / jnp.abs(new).max(), sweeps + 1

    tolerance = solver.tolerance_for(values.dtype)
    by_state, change, sweeps = jax.lax.while_loop(
        lambda state: (state[1] > tolerance) & (state[2] < max_sweeps),
        sweep,
        (own, jnp.asarray(jnp.inf, values.dtype), jnp.asarray(1)),
    )
    every_term = jax.vmap(model_term, out_axes=-1)(jnp.eye(len(parameters), dtype=parameters.dtype))
    by_action = every_term + jnp.einsum("sak,sakp->sap", next_state, by_state[now.successors])  # eq. 7
    return ForwardGradient(solution, by_state, by_action, sweeps, solution.converged & (change <= tolerance))
