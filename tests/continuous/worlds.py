"""Small worlds for the tests of the continuous half, with their exact answers by plain dense sums."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sidestep.continuous.dynamics import TableDynamics
from sidestep.continuous.policies import FinitePolicy, table_policy
from sidestep.continuous.tasks import TableTask, table_tasks
from sidestep.tabular.graph import graph
from sidestep.tabular.models import TabularModel
from sidestep.tasks import stack_tasks, task

STATES, ACTIONS = 5, 3


class Table(NamedTuple):
    """A small discrete world seen as a continuous one."""

    dynamics: TableDynamics
    tasks: TableTask
    policy: FinitePolicy
    reward: np.ndarray
    final: np.ndarray
    terminal: np.ndarray
    discount: float


def table(discount=0.9, seed=0) -> Table:
    """Five states in which three actions lead to the next, the one after, or nowhere; the last ends the task."""
    random = np.random.default_rng(seed)
    states = np.arange(STATES)[:, None, None]
    successors = np.broadcast_to((states + np.arange(3)) % STATES, (STATES, ACTIONS, 3))
    model = TabularModel(graph(np.array(successors)), jnp.asarray(random.normal(size=successors.shape)))
    reward = -random.uniform(0.2, 1.5, size=(STATES, ACTIONS))
    terminal = np.arange(STATES) == STATES - 1
    one = task(jnp.asarray(reward), discount, jnp.asarray(terminal))
    tasks = table_tasks(stack_tasks([one]), STATES, ACTIONS)
    policy = table_policy(ACTIONS, STATES)
    logits = jnp.asarray(random.normal(size=(ACTIONS, STATES)))
    policy = FinitePolicy(
        policy.network.__class__(_linear(policy, logits), jnp.zeros(STATES), jnp.ones(STATES)), policy.actions
    )
    return Table(TableDynamics(model), tasks, policy, reward, np.zeros(STATES), terminal, discount)


def _linear(policy: FinitePolicy, logits):
    import equinox as eqx

    return eqx.tree_at(lambda layer: layer.weight, policy.network.network, logits)


def policy_table(policy: FinitePolicy, states=STATES):
    """π[s, a]."""
    return jnp.exp(jax.vmap(policy.log_probs)(jnp.eye(states)))


def exact_action_values(world: Table, parameters, horizon, bonus=0.0):
    """Q of a fixed policy that looks `horizon` moves ahead; `bonus` is what every acting state adds to its value."""
    model = world.dynamics.model.with_parameters(parameters)
    transitions = jnp.zeros((STATES, ACTIONS, STATES))
    state, action = np.arange(STATES)[:, None, None], np.arange(ACTIONS)[:, None]
    transitions = transitions.at[state, action, model.graph.successors].add(model.probabilities())
    pi = policy_table(world.policy)
    values = jnp.where(world.terminal, world.final, 0.0)
    q = jnp.zeros((STATES, ACTIONS))
    for _ in range(horizon):
        q = world.reward + world.discount * transitions @ values
        values = jnp.where(world.terminal, world.final, (pi * q).sum(axis=1) + bonus)
    return q
