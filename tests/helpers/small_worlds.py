"""Small worlds for the tests of continuous worlds, with exact answers by plain dense sums."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sidestep.continuous.dynamics import LinearGaussian, TableDynamics
from sidestep.continuous.policies import FinitePolicy, GaussianPolicy, Policy, ScaledNetwork
from sidestep.continuous.tasks import QuadraticTask, TableTask
from sidestep.tabular.backups import Behavior
from sidestep.tabular.graph import graph
from sidestep.tabular.models import TabularModel
from sidestep.tabular.planning import plan
from sidestep.tabular.tasks import Task

TASKS, STATES, ACTIONS = 2, 5, 3
ENDS = jnp.eye(TASKS, STATES, dtype=bool)[:, ::-1].at[1].set(jnp.arange(STATES) == 0)
WHICH, PLACES = jnp.nonzero(~ENDS)  # every task and state that is not terminal


class Table(NamedTuple):
    """A small discrete world with two tasks as a continuous one; its policy is neither uniform nor optimal."""

    dynamics: TableDynamics
    tasks: TableTask
    policy: FinitePolicy


def table(seed=3) -> Table:
    """Five states in which three actions lead to the next, the one after, or the same; each task ends in one."""
    random = np.random.default_rng(seed)
    successors = (np.arange(STATES)[:, None, None] + np.arange(3) + np.zeros((1, ACTIONS, 1), int)) % STATES
    model = TabularModel(graph(successors), jnp.asarray(1.5 * random.normal(size=successors.shape)))
    reward = random.uniform(-1, 0.5, size=(TASKS, STATES, ACTIONS)) + np.array([0, -2, 1, -1, 0])[:, None]
    final = np.full((TASKS, STATES), [[0.5], [-1]])
    tasks = Task(jnp.asarray(reward), jnp.asarray(final), ENDS, jnp.asarray(np.array([0.8, 0.6])))
    policy = with_logits(jnp.asarray(random.normal(size=reward.shape)))
    return Table(TableDynamics(model), table_tasks(tasks, STATES, ACTIONS), policy)


def table_tasks(tasks: Task, states: int, actions: int) -> TableTask:
    """Stacked tabular tasks as continuous ones, in a world with this number of states and actions."""
    count = len(tasks.terminal)
    reward = jnp.broadcast_to(tasks.reward, (count, states, actions))
    terminal_reward = jnp.broadcast_to(tasks.terminal_reward, (count, states))
    table = Task(reward, terminal_reward, tasks.terminal, tasks.discount)
    return TableTask(task=table, index=jnp.eye(count, dtype=reward.dtype), discount=tasks.discount)


def table_policy(actions: int, features: int) -> FinitePolicy:
    """A policy with a logit of its own for every feature and action, for one-hot features."""
    linear = eqx.nn.Linear(features, actions, use_bias=False, key=jax.random.key(0))
    linear = eqx.tree_at(lambda layer: layer.weight, linear, jnp.zeros((actions, features)))
    return FinitePolicy(ScaledNetwork(linear, jnp.zeros(features), jnp.ones(features)), jnp.arange(actions))


def with_logits(logits) -> FinitePolicy:
    """The policy ∝ exp of logits[task, state, action], in the table world."""
    blank = table_policy(ACTIONS, TASKS * STATES)
    return eqx.tree_at(lambda policy: policy.network.network.weight, blank, logits.reshape(-1, ACTIONS).T)


@eqx.filter_jit
def policy_table(policy: FinitePolicy):
    """π[task, state, action]."""
    log_probs = jax.vmap(policy.log_probs)(jnp.eye(TASKS * STATES))
    return jnp.exp(log_probs).reshape(TASKS, STATES, ACTIONS)


def exact_policy(world: Table, behavior: Behavior):
    """π[task, state, action] of agents that know the world, by value iteration."""
    tasks = [jax.tree.map(lambda leaf, index=index: leaf[index], world.tasks.task) for index in range(TASKS)]
    return jnp.stack([plan(world.dynamics.model, task, behavior).policy for task in tasks])


def entropies(pi):
    """H[task, state]."""
    return -(pi * jnp.log(pi)).sum(axis=-1)


@eqx.filter_jit
def exact_values(world: Table, parameters, pi, horizon, bonus: jax.Array | float = 0.0):
    """V[task, state] and Q[task, state, action] of a fixed policy up to a horizon; acting adds `bonus` to V."""
    model, tasks = world.dynamics.model.with_parameters(parameters), world.tasks.task
    states, actions = np.arange(STATES)[:, None, None], np.arange(ACTIONS)[:, None]
    transitions = jnp.zeros((STATES, ACTIONS, STATES))
    transitions = transitions.at[states, actions, model.graph.successors].add(model.probabilities())

    def back_up(_, carry):
        q = tasks.reward + tasks.discount[:, None, None] * jnp.einsum("sat,kt->ksa", transitions, carry[0])
        return jnp.where(tasks.terminal, tasks.terminal_reward, (pi * q).sum(axis=-1) + bonus), q

    values = jnp.where(tasks.terminal, tasks.terminal_reward, 0.0)
    return jax.lax.fori_loop(0, horizon, back_up, (values, jnp.zeros_like(tasks.reward)))


GAIN, OFFSET, SPREAD = jnp.asarray([[-0.4, -0.6]]), jnp.asarray([0.1]), 0.3


class Linear(NamedTuple):
    """A linear-Gaussian world of two components and one input, with two tasks; its policy is linear, not optimal."""

    dynamics: LinearGaussian
    tasks: QuadraticTask
    policy: Policy


def linear(goals=((0.5, -0.2), (-0.3, 0.4))) -> Linear:
    state, action = [[0.9, 0.3], [-0.2, 0.8]], [[0.2], [0.7]]
    dynamics = LinearGaussian(jnp.asarray(state), jnp.asarray(action), jnp.asarray([0.2, 0.1]))
    costs = [[[1.0, 0.2], [0.2, 0.5]]] * len(goals), [[[0.3]]] * len(goals)
    tasks = QuadraticTask(*(jnp.asarray(part) for part in (goals, *costs, [0.8, 0.9][: len(goals)])))
    blank = eqx.nn.Linear(2, 1, key=jax.random.key(0))
    mean = eqx.tree_at(lambda layer: (layer.weight, layer.bias), blank, (GAIN, OFFSET))
    policy = GaussianPolicy(ScaledNetwork(mean, jnp.zeros(2), jnp.ones(2)), jnp.log(jnp.asarray([SPREAD])))
    return Linear(dynamics, tasks, policy)
