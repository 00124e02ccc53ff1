"""Gauss–Seidel and Jacobi, two programs for the same equations, give the same values and gradients."""

from itertools import product

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.problems import BACKUPS, plain_backup
from sidestep.tabular.backups import Behavior, Gradient
from sidestep.tabular.graph import graph
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid, TabularModel
from sidestep.tabular.solve import SolveOptions, solve
from sidestep.tabular.solvers.gauss_seidel import GaussSeidel
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import Task, reach, stack_tasks
from sidestep.worlds.offices import office

pytestmark = pytest.mark.slow

SOLVERS = (Jacobi(), GaussSeidel())
each_backup = pytest.mark.parametrize("name", BACKUPS)
backed_up = jax.jit(plain_backup, static_argnums=0)


@eqx.filter_jit
def solved(model, tasks, agent, solver, gradient: Gradient = "exact"):
    """A stack of tasks solved, and each task's gradient of a weighted sum of its values, by everything."""

    def total(inputs, terminal):
        parameters, reward, final, discount, beta = inputs
        wanted = Task(reward, final, terminal, discount)
        behavior = Behavior(agent.backup, beta)
        solution = solve(
            model.with_parameters(parameters), wanted, behavior, options=SolveOptions(solver=solver, gradient=gradient)
        )
        weights = jnp.asarray(np.random.default_rng(1).normal(size=solution.values.shape))
        return jnp.sum(weights * jnp.where(solution.values > -1e100, solution.values, 0)), solution

    def one(task):
        inputs = (model.parameters, task.reward, task.terminal_reward, task.discount, agent.beta)
        slopes, solution = jax.grad(total, has_aux=True)(inputs, task.terminal)
        return solution, dict(zip(("parameters", "reward", "final", "discount", "beta"), slopes, strict=True))

    return jax.vmap(one)(tasks)


def agree(model, tasks, agent, close, gradient: Gradient = "exact"):
    """Checks that both converge to the same values and gradients; returns the solution in the order of distance."""
    both = [solved(model, tasks, agent, solver, gradient) for solver in SOLVERS]
    (expected, slopes), (solution, ours) = jax.tree.map(np.asarray, both)
    assert expected.converged.all()
    assert solution.converged.all()
    lost = expected.values < -1e100
    np.testing.assert_array_equal(solution.values < -1e100, lost)
    for values, reference, out in zip(solution.values, expected.values, lost, strict=True):
        largest = np.abs(reference[~out]).max()
        np.testing.assert_allclose(values[~out], reference[~out], rtol=0, atol=1e-8 * largest)
    for key, slope in slopes.items():
        for mine, reference in zip(ours[key], slope, strict=True):
            assert np.isfinite(reference).all()
            assert np.linalg.norm(mine - reference) <= close * np.linalg.norm(reference), key
    return solution


def office_and_tasks():
    """An unmapped office, learned well: cells blocked with a probability of about .98 or .02."""
    plan = office(16, 24, 0)
    rng = np.random.default_rng(0)
    walls = plan.known.reshape(-1) == Cell.OCCUPIED
    theta = np.where(walls, 3.9, -3.9) + 0.3 * rng.normal(size=plan.size)
    goals = rng.choice(np.flatnonzero(~walls), 3, replace=False).tolist()
    world = plan.forget()
    tasks = [
        reach(world, goals[0], discount=0.9999, step_cost=1.0),
        reach(world, goals[1], discount=1.0, step_cost=1.0),
        reach(world, goals[2], discount=0.95),
    ]
    return ObstacleGrid(world, jnp.asarray(theta)), stack_tasks(tasks)


@each_backup
def test_solvers_on_an_office_agree(name):
    """Where β is extreme several fixed points may exist; then it is enough that both solve the Bellman equation."""
    model, tasks = office_and_tasks()
    agree(model, tasks, Behavior(BACKUPS[name], 5.0), 1e-6)
    tasks = eqx.tree_at(lambda tasks: tasks.discount, tasks, jnp.asarray([0.9, 0.95, 0.9]))
    for beta, solver in product((0.1, 1e3), SOLVERS):
        solution, _ = solved(model, tasks, Behavior(BACKUPS[name], beta), solver)
        assert solution.converged.all()
        values = np.asarray(solution.values)
        size = np.maximum(np.abs(values), np.abs(np.asarray(solution.action_values)).max(axis=-1))
        off = np.abs(np.asarray(backed_up(name, solution.action_values, beta)) - values)
        rounding = 1e-14 / beta  # of what the plain mellowmax takes the logarithm of
        assert (off <= 1e-9 * size + rounding)[~np.asarray(tasks.terminal)].all()


def random_graph(states=300, actions=3, outcomes=4, seed=0):
    """A graph that is no map: outcomes lead near and far, some stay, some repeat; state 0 is within reach."""
    rng = np.random.default_rng(seed)
    near = (np.arange(states)[:, None, None] + rng.integers(-5, 6, (states, actions, outcomes))) % states
    successors = np.where(rng.random(near.shape) < 0.8, near, rng.integers(0, states, near.shape))
    successors[:, 0, 0] = np.maximum(np.arange(states) - 1, 0)
    successors[:, 1, 0] = np.arange(states)
    successors[:, 2, 1] = successors[:, 2, 0]
    return TabularModel(graph(successors), jnp.asarray(2 * rng.normal(size=successors.shape)))


@pytest.mark.parametrize(
    ("name", "gradient"), [*product(BACKUPS, ["exact"]), *product(["Boltzmann", "mellowmax"], ["fixed_policy"])]
)
def test_solvers_on_a_random_graph_agree(name, gradient):
    """Ends that pay differently, and a task without an end."""
    model = random_graph()
    rng = np.random.default_rng(1)
    terminal = np.isin(np.arange(300), [0, 150, 297])

    def one(discount, low, high, ends):
        reward, final = rng.uniform(low, high, (300, 3)), rng.normal(size=300)
        return Task(jnp.asarray(reward), jnp.asarray(final), jnp.asarray(terminal & ends), jnp.asarray(discount))

    tasks = [one(0.9, -1.5, -0.5, True), one(0.9, -1.0, 1.0, False), one(1.0, -4.0, -3.0, True)]
    for beta in (0.5, 50.0):
        agree(model, stack_tasks(tasks), Behavior(BACKUPS[name], beta), 1e-6, gradient)


@each_backup
def test_solvers_on_dead_ends_and_traps_agree(name):
    """No agent passes the wall, so that at discount 1 some states have no values; some cells are hard to leave."""
    known = np.full((20, 22), Cell.UNKNOWN, dtype=np.int64)
    known[15, :] = Cell.OCCUPIED
    world = Grid(known)
    theta = np.random.default_rng(3).normal(-2, 1, world.size)
    theta[[100, 101, 122, 300]] = 21.0
    tasks = [reach(world, goal, discount=1.0, step_cost=1.0) for goal in (0, 200)]
    tasks.append(reach(world, 439, discount=0.95))
    solution = agree(ObstacleGrid(world, jnp.asarray(theta)), stack_tasks(tasks), Behavior(BACKUPS[name], 5.0), 1e-6)
    lost = solution.values < -1e100
    assert lost[:2, 16 * 22 :].all()
    assert not lost[:, : 15 * 22].any()
    assert not lost[2].any()
