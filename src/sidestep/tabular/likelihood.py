"""The likelihood of demonstrations under a transition model (eqs. 1 and 6).

    log L(θ) = Σ_i Σ_t [ log π_θ(a_t | s_t)  +  ln T_θ(s_t, a_t, s_{t+1}) ],      log π_θ = βQ_θ − log Σ_a exp βQ_θ

People plan with the dynamics that they know, so both terms depend on θ: the *actions* through the values, the observed
*transitions* directly. Each can be left out.
"""

from typing import Literal, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from sidestep.demonstrations import Demonstrations
from sidestep.tabular.backups import Behavior, Gradient
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.solve import solve
from sidestep.tabular.solvers.process import Solver

Term = Literal["actions", "transitions"]
ALL_TERMS: tuple[Term, ...] = ("actions", "transitions")


class LogLikelihood(NamedTuple):
    """The two terms of the log-likelihood, in nats; one that was left out is 0."""

    actions: Float[Array, ""]
    transitions: Float[Array, ""]

    @property
    def total(self) -> Float[Array, ""]:
        """log L(θ)."""
        return self.actions + self.transitions


def log_likelihood(
    model: TransitionModel,
    demonstrations: Demonstrations,
    behavior: Behavior,
    *,
    terms: tuple[Term, ...] = ALL_TERMS,
    horizon: int | None = None,
    gradient: Gradient = "exact",
    solver: Solver | None = None,
) -> LogLikelihood:
    """log L(θ) of `demonstrations` by people who behave as `behavior` says and know `model`.

    `terms` are those that count; the other arguments are those of `solve`. The actions' term is NaN if a task's values
    did not converge.
    """
    actions = transitions = jnp.zeros((), model.probabilities().dtype)
    if "actions" in terms:
        actions = action_log_likelihood(
            model, demonstrations, behavior, horizon=horizon, gradient=gradient, solver=solver
        )
    if "transitions" in terms:
        transitions = transition_log_likelihood(model, demonstrations)
    return LogLikelihood(actions, transitions)


def action_log_likelihood(
    model: TransitionModel,
    demonstrations: Demonstrations,
    behavior: Behavior,
    *,
    horizon: int | None = None,
    gradient: Gradient = "exact",
    solver: Solver | None = None,
) -> Float[Array, ""]:
    """Σ log π_θ(a | s) over all moves; NaN if a task's values did not converge."""
    solution = solve(model, demonstrations.tasks, behavior, horizon=horizon, gradient=gradient, solver=solver)
    # not `solution.action_values`: those of the visited states are few
    q = visited_action_values(model, demonstrations, solution.values)
    log_policy = behavior.log_policy(q)
    chosen = jnp.take_along_axis(log_policy, demonstrations.actions[:, None], axis=-1)
    # a factor, so that the gradient is NaN too
    return jnp.sum(chosen) * jnp.where(solution.converged.all(), 1.0, jnp.nan)


def visited_action_values(
    model: TransitionModel, demonstrations: Demonstrations, values: Float[Array, "tasks states"]
) -> Float[Array, "moves actions"]:
    """Q(s, a) of the state of every move, from the values of all tasks; as `DecisionProcess.action_values`."""
    tasks, task, states = demonstrations.tasks, demonstrations.task, demonstrations.states
    probabilities = model.probabilities()
    value = values[task, states]
    differences = values[task[:, None, None], model.graph.successors[states]] - value[:, None, None]
    expected = value[:, None] + jnp.sum(probabilities[states] * differences, axis=-1)
    per_state = tasks.reward.shape[1] > 1
    reward = tasks.reward[task, states if per_state else 0].astype(values.dtype)
    return reward + tasks.discount[task, None].astype(values.dtype) * expected


def transition_log_likelihood(model: TransitionModel, demonstrations: Demonstrations) -> Float[Array, ""]:
    """Σ ln T_θ(s, a, s′) over all moves."""
    return jnp.sum(jnp.log(transition_probabilities(model, demonstrations)))


def transition_probabilities(model: TransitionModel, demonstrations: Demonstrations) -> Float[Array, " moves"]:
    """T_θ(s, a, s′) of every move."""
    states, actions = demonstrations.states, demonstrations.actions
    leads_there = model.graph.successors[states, actions] == demonstrations.next_states[:, None]
    return jnp.sum(jnp.where(leads_there, model.probabilities()[states, actions], 0), axis=-1)
