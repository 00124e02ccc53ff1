"""Values of a task under a model, differentiable with respect to everything that they depend on.

The values solve V = F(V, φ), F one backup and φ all of the probabilities, rewards, discount and β. By the implicit
function theorem a scalar with gradient g with respect to V has gradient λᵀ ∂F/∂φ with respect to φ, where
λ = g + (∂F/∂V)ᵀ λ (the adjoint equation, solved in `sweeps`). One adjoint solve serves any number of parameters, so a
gradient costs about what the values cost. `gradient="fixed_policy"` puts the average under the policy held fixed in the
place of B in ∂F (eqs. 7, 9 and 10); with the Boltzmann average that is not the gradient of any function.

An adjoint that does not converge gives a gradient of NaN, never a wrong one.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sidestep.errors import ImproperTask, InputError
from sidestep.tabular.backups import Backup, Behavior, Gradient, LogSumExp
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.sweeps import DecisionProcess, Jacobi, Sweeps, at_fixed_policy, finite_horizon, reachable
from sidestep.tasks import Task


class Solution(eqx.Module):
    """The values of a task under a model, and how the solve went (with a leading `tasks` axis for several tasks).

    - `values`: V(s); at discount 1, states that cannot reach a terminal state are near `sweeps.lowest` (for −∞).
    - `action_values`: Q(s, a).
    - `sweeps`, `residual`, `converged`: see `sweeps.Sweeps`; a finite horizon takes one exact sweep an action.
    """

    values: Float[Array, "*tasks states"]
    action_values: Float[Array, "*tasks states actions"]
    sweeps: Int[Array, "*tasks"]
    residual: Float[Array, "*tasks"]
    converged: Bool[Array, "*tasks"]


def solve(
    model: TransitionModel,
    task: Task,
    behavior: Behavior,
    *,
    horizon: int | None = None,
    gradient: Gradient = "exact",
    solver: Jacobi | None = None,
) -> Solution:
    """The values of one task, or of a stack of tasks, for people who behave as `behavior` says under `model`.

    - `horizon`: how many actions people look ahead; None for the fixed point of the Bellman equation.
    - `gradient`: what derivatives of the solution mean, "exact" or "fixed_policy" (eqs. 9, 10).
    - `solver`: how the fixed point is found.

    The numbers have the dtype of the model's probabilities. May be used under `jit`, `vmap` and `grad`. Look at
    `converged` before you use the numbers; `check_proper` tells beforehand whether values exist.
    """
    if horizon is not None and horizon < 1:
        raise InputError(f"expected at least one action, found {horizon}", field="horizon")
    probabilities = model.probabilities()
    dtype = probabilities.dtype
    behavior = eqx.tree_at(lambda people: people.beta, behavior, behavior.beta.astype(dtype))

    def one(task: Task) -> Solution:
        process = DecisionProcess(
            model.graph.successors,
            probabilities,
            task.reward.astype(dtype),
            task.final_reward.astype(dtype),
            task.terminal,
            task.discount.astype(dtype),
        )
        if horizon is None:
            found = _solve_fixed_point(process, behavior, gradient, solver or Jacobi())
        else:
            values = finite_horizon(process, behavior.backup, behavior.beta, horizon, gradient)
            residual = jnp.asarray(0, values.dtype)
            found = Sweeps(values, jnp.asarray(horizon), residual, jnp.isfinite(values).all())
        q = process.action_values(found.values)
        return Solution(found.values, q, found.sweeps, found.residual, found.converged)

    return jax.vmap(one)(task) if task.terminal.ndim == 2 else one(task)


def check_proper(task: Task, behavior: Behavior, actions: int, horizon: int | None = None) -> None:
    """Raises `ImproperTask` unless the values of every task (one or a stack) are finite and unique.

    A finite horizon or a discount below 1 always is proper. At discount 1 a task must end somewhere and every action
    must cost something; for log-sum-exp people more than log(actions)/β, which is what a choice is worth to them: if it
    costs less they gain by never arriving.
    """
    endless = np.atleast_1d(np.asarray(task.discount)) == 1
    if horizon is not None or not endless.any():
        return
    terminal = np.atleast_2d(np.asarray(task.terminal))
    reward = np.asarray(task.reward).reshape(-1, *task.reward.shape[-2:]).max(axis=-1)
    acting = np.where(terminal, -np.inf, np.broadcast_to(reward, terminal.shape)).max(axis=-1)
    if (endless & ~terminal.any(axis=-1)).any():
        raise ImproperTask("a task with discount 1 needs a terminal state: expected one, or a discount below 1")
    if (endless & (acting >= 0)).any():
        raise ImproperTask("at discount 1 every action must cost something: expected rewards below 0")
    bonus = np.log(actions) / float(behavior.beta)
    if isinstance(behavior.backup, LogSumExp) and (endless & (acting >= -bonus)).any():
        raise ImproperTask(
            f"at discount 1 a log-sum-exp walker with β = {float(behavior.beta):g} and {actions} actions gains "
            f"log(actions)/β = {bonus:.4g} with every action and never wants to arrive: expected a step cost "
            "above that, a larger β, a discount below 1 or another backup"
        )


def _solve_fixed_point(process: DecisionProcess, behavior: Behavior, gradient: Gradient, solver: Jacobi) -> Sweeps:
    given = (process.successors, process.terminal)
    varying = (process.probabilities, process.reward, process.final_reward, process.discount, behavior.beta)
    held = jax.lax.stop_gradient(varying)
    found = solver.values(_process(given, held), behavior.backup, held[-1])
    return found._replace(values=_implicit(solver, behavior.backup, gradient, given, varying, found.values))


def _process(given: tuple, varying: tuple) -> DecisionProcess:
    (successors, terminal), (probabilities, reward, final_reward, discount, _) = given, varying
    return DecisionProcess(successors, probabilities, reward, final_reward, terminal, discount)


@partial(jax.custom_vjp, nondiff_argnums=(0, 1, 2))
def _implicit(
    solver: Jacobi,
    backup: Backup,
    gradient: Gradient,
    given: tuple,
    varying: tuple,
    values: Float[Array, " states"],
) -> Float[Array, " states"]:
    """`values`, the solution V of V = F(V, φ) with φ = `varying`, with their gradient by the adjoint equation."""
    del solver, backup, gradient, given, varying
    return values


def _implicit_forward(solver: Jacobi, backup: Backup, gradient: Gradient, given: tuple, varying: tuple, values: Array):
    del solver, backup, gradient
    return values, (given, varying, values)


def _implicit_backward(solver: Jacobi, backup: Backup, gradient: Gradient, saved: tuple, cotangent: Array):
    given, varying, values = saved
    process, beta = _process(given, varying), varying[-1]
    # states that cannot reach a terminal state have no values to speak of, and no part in the gradient
    live = reachable(values) & ~process.terminal
    q = jnp.where(live[:, None], process.action_values(values), 0)
    policy = backup.fixed_policy_weights(q, beta)
    weights = backup.weights(q, beta) if gradient == "exact" else policy
    found = solver.adjoint(process, weights, policy, live, cotangent)
    adjoint = jnp.where(found.converged, found.values, jnp.nan)

    def one_backup(varying: tuple) -> Float[Array, " states"]:
        process, beta = _process(given, varying), varying[-1]
        q = jnp.where(live[:, None], process.action_values(values), 0)
        backed_up = backup.value(q, beta) if gradient == "exact" else at_fixed_policy(backup, beta, q)
        return process.end(jnp.where(live, backed_up, 0))

    return None, jax.vjp(one_backup, varying)[1](adjoint)[0], jnp.zeros_like(values)


_implicit.defvjp(_implicit_forward, _implicit_backward)
