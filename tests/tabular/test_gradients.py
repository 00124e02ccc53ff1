"""Gradients three ways: implicit, automatic differentiation of plain value iteration, central differences.

And those of policies held fixed (eqs. 9 and 10) beside the paper's forward dynamic programme (eq. 7).
"""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from helpers.problems import (
    BACKUPS,
    DISCOUNTS,
    FAMILIES,
    NAMES,
    PROBLEMS,
    dense_obstacles,
    generic_task,
    plain_backup,
    plain_policy,
    plain_values,
    relative_error,
)
from sidestep.tabular.backups import Behavior
from sidestep.tabular.demonstrations import Demonstrations, Trajectory, gather
from sidestep.tabular.grid import Grid
from sidestep.tabular.likelihood import log_likelihood
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.solve import SolveOptions, solve
from sidestep.tabular.tasks import Task, reach, stack_tasks

BETA = 4.0
HORIZONS = (None, 6)
EVERY = PROBLEMS | FAMILIES
CLOSE = 1e-6
ENOUGH = 900  # plain sweeps to a fixed point: .95^900 < 1e-20
STEP = {"hard max": 2e-6}  # of differences; small where there may be kinks nearby, else 1e-4
each_backup = pytest.mark.parametrize("name", BACKUPS)
on_two_graphs = pytest.mark.parametrize("graph", ["8-connected", "tabular"])
each_discount = pytest.mark.parametrize("discount", DISCOUNTS)
each_horizon = pytest.mark.parametrize("horizon", HORIZONS)


def varied(graph: str, discount: float) -> dict:
    """Everything that a solution depends on: what the gradients are with respect to."""
    problem = PROBLEMS[graph]
    task = generic_task(problem, discount)
    inputs = {"parameters": problem.model.parameters, "beta": jnp.asarray(BETA)}
    return inputs | {"reward": task.reward, "final": task.terminal_reward, "discount": task.discount}


def functional(values, q):
    """A scalar that depends on every value and action value."""
    rng = np.random.default_rng(7)
    return jnp.sum(rng.normal(size=values.shape) * values) + jnp.sum(rng.normal(size=q.shape) * q)


def solved(graph: str, name: str, horizon, gradient, inputs) -> tuple:
    problem = PROBLEMS[graph]
    task = Task(inputs["reward"], inputs["final"], jnp.arange(problem.states) == problem.goal, inputs["discount"])
    model = problem.model.with_parameters(inputs["parameters"])
    found = solve(
        model, task, Behavior(BACKUPS[name], inputs["beta"]), options=SolveOptions(horizon=horizon, gradient=gradient)
    )
    return found.values, found.action_values


@cache
def implicit(graph: str, name: str, horizon, gradient="exact"):
    """A compiled function of the inputs: the functional and its gradient, through the library."""
    return jax.jit(jax.value_and_grad(lambda inputs: functional(*solved(graph, name, horizon, gradient, inputs))))


@cache
def unrolled(graph: str):
    """The same of the index of a backup, the number of plain sweeps, and the inputs."""
    problem = PROBLEMS[graph]

    def total(kind, sweeps, inputs):
        terminal = jnp.arange(problem.states) == problem.goal
        task = Task(inputs["reward"], inputs["final"], terminal, inputs["discount"])
        return functional(*plain_values(kind, problem.dense(inputs["parameters"]), task, inputs["beta"], sweeps))

    return jax.jit(jax.value_and_grad(total, argnums=2))


def unit(direction):
    return direction / np.linalg.norm(direction)


def central_difference(function, inputs, direction, step) -> float:
    """The directional derivative, to fourth order."""

    def at(distance):
        return float(function(jax.tree.map(lambda x, d: x + distance * np.asarray(d), inputs, direction)))

    return (8 * (at(step) - at(-step)) - (at(2 * step) - at(-2 * step))) / (12 * step)


@each_horizon
@each_discount
@each_backup
@on_two_graphs
def test_solve_three_ways(graph, name, discount, horizon):
    inputs = varied(graph, discount)
    plain = partial(unrolled(graph), NAMES.index(name), horizon or ENOUGH)
    value, found = implicit(graph, name, horizon)(inputs)
    expected_value, expected = plain(inputs)
    assert float(value) == pytest.approx(float(expected_value), rel=1e-8)
    rng, step = np.random.default_rng(11), STEP.get(name, 1e-4)
    for key, gradient in expected.items():
        if key == "beta" and name == "hard max":
            assert found[key] == gradient == 0
            continue
        assert relative_error(found[key], gradient) < CLOSE, key
        direction = {other: unit(rng.normal(size=gradient.shape)) if other == key else 0.0 for other in inputs}
        difference = central_difference(lambda inputs: plain(inputs)[0], inputs, direction, step)
        assert float(np.sum(found[key] * direction[key])) == pytest.approx(difference, rel=CLOSE, abs=1e-14 / step), key


def demonstrated(graph: str) -> Demonstrations:
    """A few random walks on three tasks, one for each discount."""
    problem = EVERY[graph]
    rng = np.random.default_rng(3)
    successors = np.asarray(problem.model.graph.successors)
    trajectories = []
    for task in (0, 1, 2, 1):
        states, actions = [problem.states - 1], []
        while len(actions) < 6 and states[-1] != problem.goal:
            actions.append(int(rng.integers(problem.actions)))
            likely = np.asarray(problem.model.probabilities()[states[-1], actions[-1]])
            states.append(int(rng.choice(successors[states[-1], actions[-1]][likely > 0])))
        trajectories.append(Trajectory(np.array(states), np.array(actions), task))
    return gather(trajectories, [generic_task(problem, discount, seed) for seed, discount in enumerate(DISCOUNTS)])


@cache
def unrolled_log_likelihood(graph: str):
    """Eqs. 1 and 6, written out: value and gradient of the index of a backup, the plain sweeps, and θ."""
    demos = demonstrated(graph)

    def total(kind, sweeps, parameters):
        transitions = EVERY[graph].dense(parameters)
        q = jax.vmap(lambda task: plain_values(kind, transitions, task, BETA, sweeps)[1])(demos.tasks)
        log_policy = jnp.log(plain_policy(q, BETA))[demos.task, demos.states, demos.actions]
        return jnp.sum(log_policy + jnp.log(transitions[demos.states, demos.actions, demos.next_states]))

    return jax.jit(jax.value_and_grad(total, argnums=2))


@each_horizon
@each_backup
@on_two_graphs
def test_log_likelihood_three_ways(graph, name, horizon):
    check_log_likelihood(graph, name, horizon)


@pytest.mark.parametrize("name", ["hard max", "Boltzmann"])
@pytest.mark.parametrize("family", FAMILIES)
def test_log_likelihood_of_every_family_three_ways(family, name):
    check_log_likelihood(family, name, None)


def check_log_likelihood(graph, name, horizon):
    model, demos, behavior = EVERY[graph].model, demonstrated(graph), Behavior(BACKUPS[name], BETA)

    @jax.jit
    @jax.value_and_grad
    def ours(parameters):
        return log_likelihood(
            model.with_parameters(parameters), demos, behavior, options=SolveOptions(horizon=horizon)
        ).total

    plain = partial(unrolled_log_likelihood(graph), NAMES.index(name), horizon or ENOUGH)
    (value, found), (expected_value, expected) = ours(model.parameters), plain(model.parameters)
    assert float(value) == pytest.approx(float(expected_value), rel=1e-8)
    (found, _), (expected, unravel) = ravel_pytree(found), ravel_pytree(expected)
    assert relative_error(found, expected) < CLOSE
    step = STEP.get(name, 1e-4)
    direction = unit(np.random.default_rng(5).normal(size=found.shape))
    difference = central_difference(lambda p: plain(p)[0], model.parameters, unravel(jnp.asarray(direction)), step)
    assert float(np.sum(found * direction)) == pytest.approx(difference, rel=CLOSE, abs=1e-14 / step)


def policy_held_fixed(kind, q, beta):
    """π of eq. 9, or for the hard max eq. 10: uniform over the best actions."""
    best = jnp.isclose(q, q.max(axis=-1, keepdims=True), rtol=1e-9, atol=0)
    uniform = best / best.sum(axis=-1, keepdims=True)
    return jnp.where(kind == NAMES.index("hard max"), uniform, plain_policy(q, beta))


@partial(jax.jit, static_argnames="dense")
def forward(dense, kind, parameters, task: Task, start, sweeps):
    transitions = dense(parameters)
    slope = jax.jacobian(dense)(parameters).reshape(*transitions.shape, -1)

    def d_q_of(values, d_values):
        through_model = slope.transpose(0, 1, 3, 2) @ values
        return task.discount * (through_model + jnp.einsum("sat,tp->sap", transitions, d_values))

    def step(_, carried):
        values, d_values = carried
        q = task.reward + task.discount * transitions @ values
        d_values = jnp.einsum("sa,sap->sp", policy_held_fixed(kind, q, BETA), d_q_of(values, d_values))
        values = jnp.where(task.terminal, task.terminal_reward, plain_backup(kind, q, BETA))
        return values, jnp.where(task.terminal[:, None], 0, d_values)

    values, _ = plain_values(kind, transitions, task, BETA, start)
    nothing = jnp.zeros((len(transitions), slope.shape[-1]))
    values, d_values = jax.lax.fori_loop(0, sweeps, step, (values, nothing))
    return d_values, d_q_of(values, d_values)


def forward_programme(name: str, dense, parameters, task: Task, horizon):
    """(dV/dθ, dQ/dθ), parameters last, at the policy held fixed: eq. 7 with eq. 9 or 10, carried forward with V.

    A finite horizon starts from no values at all, the infinite one from values that have settled.
    """
    start, sweeps = (0, horizon) if horizon else (ENOUGH, ENOUGH)
    return forward(dense, NAMES.index(name), parameters, task, start, sweeps)


@cache
def fixed_policy_jacobian(graph: str, name: str, horizon):
    """A compiled function of θ and a task: (dV/dθ, dQ/dθ), row by row by the custom VJP."""
    model, behavior = PROBLEMS[graph].model, Behavior(BACKUPS[name], BETA)

    def values(parameters, task):
        found = solve(
            model.with_parameters(parameters),
            task,
            behavior,
            options=SolveOptions(horizon=horizon, gradient="fixed_policy"),
        )
        return found.values, found.action_values

    return jax.jit(jax.jacrev(values))


@each_horizon
@each_discount
@each_backup
@on_two_graphs
def test_fixed_policy_is_the_forward_programme(graph, name, discount, horizon):
    problem, task = PROBLEMS[graph], generic_task(PROBLEMS[graph], discount)
    found = fixed_policy_jacobian(graph, name, horizon)(problem.model.parameters, task)
    expected = forward_programme(name, problem.dense, problem.model.parameters, task, horizon)
    for ours, theirs in zip(found, expected, strict=True):
        assert relative_error(np.reshape(ours, theirs.shape), theirs) < CLOSE


@each_horizon
@pytest.mark.parametrize("connectivity", [4, 8])
def test_hard_max_shares_its_gradient_among_ties(connectivity, horizon):
    """On a symmetric map the ways tie; eq. 10 with a uniform policy over them gives a symmetric gradient."""
    grid = Grid.unknown(3, 3, connectivity)
    model, task = ObstacleGrid(grid, -1.0), reach(grid, 8, discount=0.9)

    @jax.jit
    @jax.jacrev
    def jacobian(parameters):
        moved = model.with_parameters(parameters)
        return solve(moved, task, Behavior(BACKUPS["hard max"], BETA), options=SolveOptions(horizon=horizon)).values

    found = jacobian(model.parameters)
    dense = partial(dense_obstacles, rows=3, columns=3, connectivity=connectivity)
    expected, _ = forward_programme("hard max", dense, model.parameters, task, horizon)
    assert relative_error(found, expected) < CLOSE
    from_corner = np.asarray(found)[0].reshape(3, 3)
    assert np.allclose(from_corner, from_corner.T)  # the start lies on the axis of symmetry


@each_horizon
@each_backup
def test_fixed_policy_is_exact_but_for_the_boltzmann_average(name, horizon):
    inputs = varied("4-connected", 0.95)
    exact, fixed = (
        implicit("4-connected", name, horizon, gradient)(inputs)[1] for gradient in ("exact", "fixed_policy")
    )
    error = relative_error(fixed["parameters"], exact["parameters"])
    assert error > 1e-2 if name == "Boltzmann" else error < 1e-9


@each_backup
def test_fixed_policy_likelihood_has_the_gradient_of_equation_6(name):
    """∇L = Σ [β ∇Q(s, a) − β Σ_b π(b) ∇Q(s, b) + ∇ ln T], ∇V of eq. 6 being that of log Σ exp βQ / β."""
    problem, demos = PROBLEMS["4-connected"], demonstrated("4-connected")
    theta = problem.model.parameters

    def ours(parameters):
        model = problem.model.with_parameters(parameters)
        return log_likelihood(
            model, demos, Behavior(BACKUPS[name], BETA), options=SolveOptions(gradient="fixed_policy")
        ).total

    def log_transition(parameters):
        return jnp.log(problem.dense(parameters)[demos.states, demos.actions, demos.next_states])

    expected = jax.jacobian(log_transition)(theta).sum(axis=0)
    for index, discount in enumerate(DISCOUNTS):
        task = generic_task(problem, discount, seed=index)
        _, d_q = forward_programme(name, problem.dense, theta, task, None)
        policy = plain_policy(plain_values(name, problem.dense(theta), task, BETA, ENOUGH)[1], BETA)
        for s, a in zip(*(x[demos.task == index] for x in (demos.states, demos.actions)), strict=True):
            expected += BETA * (d_q[s, a] - policy[s] @ d_q[s])
    assert relative_error(jax.jit(jax.grad(ours))(theta), expected) < CLOSE


@each_backup
@pytest.mark.parametrize("gradient", ["exact", "fixed_policy"])
def test_a_stack_of_tasks_is_each_task_by_itself(name, gradient):
    problem = PROBLEMS["8-connected"]
    tasks = [generic_task(problem, discount, seed) for seed, discount in enumerate(DISCOUNTS)]

    @jax.jit
    @jax.value_and_grad
    def both(parameters, task):
        model = problem.model.with_parameters(parameters)
        values = solve(model, task, Behavior(BACKUPS[name], BETA), options=SolveOptions(gradient=gradient)).values
        return jnp.sum(jnp.cos(values))

    together = both(problem.model.parameters, stack_tasks(tasks))
    alone = [both(problem.model.parameters, task) for task in tasks]
    assert float(together[0]) == pytest.approx(sum(float(value) for value, _ in alone), rel=1e-9)
    assert relative_error(together[1], sum(gradient for _, gradient in alone)) < 1e-9


def test_compiled_and_plain_gradients_agree():
    inputs = varied("tabular", 0.95)
    compiled = implicit("tabular", "Boltzmann", None)(inputs)
    eager = jax.value_and_grad(lambda inputs: functional(*solved("tabular", "Boltzmann", None, "exact", inputs)))(
        inputs
    )
    for key in inputs:
        assert relative_error(compiled[1][key], eager[1][key]) < 1e-12
