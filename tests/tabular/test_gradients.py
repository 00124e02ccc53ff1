"""Gradients three ways: implicit, automatic differentiation of plain value iteration, central differences.

And those of policies held fixed (eqs. 9 and 10) beside the paper's forward dynamic program (eq. 7).
"""

from functools import cache, partial
from itertools import product

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

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
from sidestep.tabular.tasks import Task, reach

pytestmark = pytest.mark.slow

BETA = 4.0
EVERY = PROBLEMS | FAMILIES
CLOSE = 1e-6
ENOUGH = 400  # plain sweeps to a fixed point: .9^400 < 1e-18
STEP = {"hard max": 2e-6}  # of differences; small where there may be kinks nearby, else 1e-4
each_backup = pytest.mark.parametrize("name", BACKUPS)
on_two_graphs = pytest.mark.parametrize(
    ("graph", "horizon"), [("8-connected", None), ("8-connected", 6), ("tabular", None)]
)
each_discount = pytest.mark.parametrize("discount", DISCOUNTS)


def inputs_of(graph: str, discount: float) -> dict:
    """Everything that a solution depends on: what the gradients are with respect to."""
    problem = PROBLEMS[graph]
    task = generic_task(problem, discount)
    inputs = {"parameters": problem.model.parameters, "beta": jnp.asarray(BETA)}
    return inputs | {"reward": task.reward, "final": task.terminal_reward, "discount": task.discount}


def task_of(graph: str, inputs: dict) -> Task:
    terminal = jnp.arange(PROBLEMS[graph].states) == PROBLEMS[graph].goal
    return Task(inputs["reward"], inputs["final"], terminal, inputs["discount"])


def weights_of(*shapes):
    """Of each value and action value in the functional whose gradient is compared."""
    rng = np.random.default_rng(7)
    return [rng.normal(size=shape) for shape in shapes]


def functional(values, q):
    return sum(jnp.sum(by * x) for by, x in zip(weights_of(values.shape, q.shape), (values, q), strict=True))


def solved(graph: str, name: str, horizon, inputs):
    model = PROBLEMS[graph].model.with_parameters(inputs["parameters"])
    behavior = Behavior(BACKUPS[name], inputs["beta"])
    solution = solve(model, task_of(graph, inputs), behavior, options=SolveOptions(horizon=horizon))
    return functional(solution.values, solution.action_values)


@cache
def implicit(graph: str, name: str, horizon):
    """A compiled function of the inputs: the functional and its gradient, through the library."""
    return jax.jit(jax.value_and_grad(partial(solved, graph, name, horizon)))


@partial(jax.jit, static_argnums=0)
def references(function, point, directions):
    """Of a function of a backup's index and a point: for each backup its value and gradient, and central differences.

    The differences are of fourth order, along each of the directions.
    """
    kinds, steps = jnp.arange(len(NAMES)), jnp.asarray([STEP.get(name, 1e-4) for name in NAMES])

    def difference(kind, step, direction):
        def at(distance):
            return function(kind, jax.tree.map(lambda x, d: x + distance * step * d, point, direction))

        low, lower, upper, high = jax.vmap(at)(jnp.asarray([-2.0, -1.0, 1.0, 2.0]))
        return (8 * (upper - lower) - (high - low)) / (12 * step)

    values, gradients = jax.vmap(jax.value_and_grad(function, 1), (0, None))(kinds, point)
    return values, gradients, jax.vmap(jax.vmap(difference, (None, None, 0)), (0, 0, None))(kinds, steps, directions)


def flat(tree):
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)])


def check_along(name, gradient, direction, difference):
    along = sum(np.sum(g * d) for g, d in zip(*map(jax.tree.leaves, (gradient, direction)), strict=True))
    assert along == pytest.approx(float(difference), rel=CLOSE, abs=1e-14 / STEP.get(name, 1e-4))


@cache
def unrolled(graph: str, sweeps: int):
    """The functional, written out plainly."""

    def total(kind, inputs):
        transitions = PROBLEMS[graph].dense(inputs["parameters"])
        return functional(*plain_values(kind, transitions, task_of(graph, inputs), inputs["beta"], sweeps))

    return total


@cache
def solve_references(graph: str, discount: float, horizon):
    """The references of the functional along a direction in each input, and the directions."""
    inputs, rng = inputs_of(graph, discount), np.random.default_rng(11)
    draws = {key: rng.normal(size=np.shape(value)) for key, value in inputs.items()}
    directions = {
        key: np.stack([(key == other) * draws[key] / np.linalg.norm(draws[key]) for other in inputs]) for key in inputs
    }
    return *jax.tree.map(np.asarray, references(unrolled(graph, horizon or ENOUGH), inputs, directions)), directions


@each_discount
@each_backup
@on_two_graphs
def test_solve_gradient_equals_autodiff_and_central_differences(graph, name, discount, horizon):
    values, gradients, differences, directions = solve_references(graph, discount, horizon)
    value, gradient = implicit(graph, name, horizon)(inputs_of(graph, discount))
    kind = NAMES.index(name)
    assert float(value) == pytest.approx(float(values[kind]), rel=1e-8)
    for index, key in enumerate(directions):
        if key == "beta" and name == "hard max":
            assert gradient[key] == gradients[key][kind] == 0
            continue
        assert relative_error(gradient[key], gradients[key][kind]) < CLOSE, key
        check_along(name, gradient[key], directions[key][index], differences[kind, index])


def demonstrated(graph: str) -> Demonstrations:
    """A few random walks on two tasks, one for each discount."""
    problem = EVERY[graph]
    rng = np.random.default_rng(3)
    successors = np.asarray(problem.model.graph.successors)
    probabilities = np.asarray(eqx.filter_jit(problem.model.probabilities)())
    trajectories = []
    for task in (0, 1, 1, 0):
        states, actions = [problem.states - 1], []
        while len(actions) < 6 and states[-1] != problem.goal:
            usable = np.broadcast_to(problem.model.graph.available, successors.shape[:2])[states[-1]]
            actions.append(int(rng.choice(np.flatnonzero(usable))))
            likely = probabilities[states[-1], actions[-1]]
            states.append(int(rng.choice(successors[states[-1], actions[-1]][likely > 0])))
        trajectories.append(Trajectory(np.array(states), np.array(actions), task))
    return gather(trajectories, [generic_task(problem, discount, seed) for seed, discount in enumerate(DISCOUNTS)])


def unrolled_log_likelihood(graph: str, sweeps: int):
    """Eqs. 1 and 6, written out plainly."""
    demos, available = demonstrated(graph), EVERY[graph].available

    def total(kind, parameters):
        transitions = EVERY[graph].dense(parameters)
        q = jax.vmap(lambda task: plain_values(kind, transitions, task, BETA, sweeps, available)[1])(demos.tasks)
        log_policy = jnp.log(plain_policy(q, BETA, available)[demos.task, demos.states, demos.actions])
        return jnp.sum(log_policy + jnp.log(transitions[demos.states, demos.actions, demos.next_states]))

    return total


@cache
def likelihood_references(graph: str, horizon):
    """The references of the log-likelihood along one direction, and the direction."""
    point, rng = EVERY[graph].model.parameters, np.random.default_rng(5)
    drawn = jax.tree.map(lambda leaf: rng.normal(size=(1, *leaf.shape)), point)
    directions = jax.tree.map(lambda leaf: leaf / np.linalg.norm(flat(drawn)), drawn)
    function = unrolled_log_likelihood(graph, horizon or ENOUGH)
    return *jax.tree.map(np.asarray, references(function, point, directions)), directions


@pytest.mark.parametrize(
    ("graph", "name", "horizon"),
    [
        *product(["8-connected"], BACKUPS, [None]),
        *product(["tabular", *FAMILIES], ["Boltzmann"], [None]),
        ("8-connected", "Boltzmann", 6),
    ],
)
def test_log_likelihood_gradient_equals_autodiff_and_central_differences(graph, name, horizon):
    model, demos, behavior = EVERY[graph].model, demonstrated(graph), Behavior(BACKUPS[name], BETA)

    @jax.jit
    @jax.value_and_grad
    def likelihood(parameters):
        options = SolveOptions(horizon=horizon)
        return log_likelihood(model.with_parameters(parameters), demos, behavior, options=options).total

    value, gradient = likelihood(model.parameters)
    kind, (values, gradients, differences, directions) = NAMES.index(name), likelihood_references(graph, horizon)
    assert float(value) == pytest.approx(float(values[kind]), rel=1e-8)
    assert relative_error(flat(gradient), flat(jax.tree.map(lambda leaf: leaf[kind], gradients))) < CLOSE
    check_along(name, gradient, directions, differences[kind, 0])


def policy_held_fixed(kind, q, beta):
    """π of eq. 9, or for the hard max eq. 10: uniform over the best actions."""
    best = jnp.isclose(q, q.max(axis=-1, keepdims=True), rtol=1e-9, atol=0)
    uniform = best / best.sum(axis=-1, keepdims=True)
    return jnp.where(kind == NAMES.index("hard max"), uniform, plain_policy(q, beta))


@partial(jax.jit, static_argnums=(0, 3))
def forward_program(dense, parameters, task: Task, horizon):
    """(dV/dθ, dQ/dθ, Q) of each backup, parameters last, with the policy held fixed: eq. 7 with eq. 9 or 10.

    A finite horizon starts from values of 0, the infinite one from converged values.
    """
    transitions = dense(parameters)
    slope = jax.jacobian(dense)(parameters).reshape(*transitions.shape, -1)
    sweeps = horizon or ENOUGH

    def d_q_of(values, d_values):
        through_model = slope.transpose(0, 1, 3, 2) @ values
        return task.discount * (through_model + jnp.einsum("sat,tp->sap", transitions, d_values))

    def one(kind):
        def step(_, carried):
            values, d_values = carried
            q = task.reward + task.discount * transitions @ values
            d_values = jnp.einsum("sa,sap->sp", policy_held_fixed(kind, q, BETA), d_q_of(values, d_values))
            values = jnp.where(task.terminal, task.terminal_reward, plain_backup(kind, q, BETA))
            return values, jnp.where(task.terminal[:, None], 0, d_values)

        values = jnp.where(task.terminal, task.terminal_reward, 0.0)
        if not horizon:
            values, _ = plain_values(kind, transitions, task, BETA, ENOUGH)
        # Q of an agent that acts n times is by the values of acting n − 1 times
        after = jax.lax.fori_loop(0, sweeps - 1, step, (values, jnp.zeros((len(transitions), slope.shape[-1]))))
        d_values = step(0, after)[1]
        return d_values, d_q_of(*after), task.reward + task.discount * transitions @ after[0]

    return jax.vmap(one)(jnp.arange(len(NAMES)))


@cache
def forward_jacobians(graph: str, discount: float, seed: int, horizon):
    problem = PROBLEMS[graph]
    task = generic_task(problem, discount, seed)
    return jax.tree.map(np.asarray, forward_program(problem.dense, problem.model.parameters, task, horizon))


@cache
def fixed_policy_jacobian(graph: str, name: str, horizon):
    """A compiled function of θ and a task: (dV/dθ, dQ/dθ), row by row by the custom VJP."""
    model, behavior = PROBLEMS[graph].model, Behavior(BACKUPS[name], BETA)
    options = SolveOptions(horizon=horizon, gradient="fixed_policy")

    def values(parameters, task):
        solution = solve(model.with_parameters(parameters), task, behavior, options=options)
        return solution.values, solution.action_values

    return jax.jit(jax.jacrev(values))


@each_discount
@each_backup
@on_two_graphs
def test_solve_fixed_policy_gradient_equals_the_forward_program(graph, name, discount, horizon):
    """It is also the exact gradient, but for the Boltzmann average."""
    inputs = inputs_of(graph, discount)
    jacobians = fixed_policy_jacobian(graph, name, horizon)(inputs["parameters"], task_of(graph, inputs))
    expected = [each[NAMES.index(name)] for each in forward_jacobians(graph, discount, 0, horizon)[:2]]
    for ours, theirs in zip(jacobians, expected, strict=True):
        assert relative_error(np.reshape(ours, theirs.shape), theirs) < CLOSE
    by_values, by_q = weights_of(*(each.shape[:-1] for each in expected))
    fixed = np.tensordot(by_values, jacobians[0], 1) + np.tensordot(by_q, jacobians[1], 2)
    exact = implicit(graph, name, horizon)(inputs)[1]["parameters"]
    assert relative_error(fixed, exact) > 1e-2 if name == "Boltzmann" else relative_error(fixed, exact) < 1e-8


@pytest.mark.parametrize("horizon", [None, 6])
def test_solve_gradient_of_the_hard_max_is_shared_among_ties(horizon):
    """On a symmetric map the paths tie; eq. 10 with a uniform policy over them gives a symmetric gradient."""
    grid = Grid.unknown(3, 3)
    model, task = ObstacleGrid(grid, -1.0), reach(grid, 8, discount=0.9)
    behavior, options = Behavior(BACKUPS["hard max"], BETA), SolveOptions(horizon=horizon)

    @jax.jit
    @jax.jacrev
    def jacobian(parameters):
        return solve(model.with_parameters(parameters), task, behavior, options=options).values

    gradient = jacobian(model.parameters)
    dense = partial(dense_obstacles, rows=3, columns=3, connectivity=4)
    expected, *_ = forward_program(dense, model.parameters, task, horizon)
    assert relative_error(gradient, expected[NAMES.index("hard max")]) < CLOSE
    from_corner = np.asarray(gradient)[0].reshape(3, 3)
    assert np.allclose(from_corner, from_corner.T)  # the start lies on the axis of symmetry


@each_backup
def test_log_likelihood_fixed_policy_gradient_equals_equation_6(name):
    """∇L = Σ [β ∇Q(s, a) − β Σ_b π(b) ∇Q(s, b) + ∇ ln T], ∇V of eq. 6 being that of log Σ exp βQ / β."""
    problem, demos = PROBLEMS["8-connected"], demonstrated("8-connected")
    theta, options = problem.model.parameters, SolveOptions(gradient="fixed_policy")

    def likelihood(parameters):
        model = problem.model.with_parameters(parameters)
        return log_likelihood(model, demos, Behavior(BACKUPS[name], BETA), options=options).total

    def log_transition(parameters):
        return jnp.log(problem.dense(parameters)[demos.states, demos.actions, demos.next_states]).sum()

    expected = np.array(jax.jit(jax.grad(log_transition))(theta))
    for index, discount in enumerate(DISCOUNTS):
        forward = forward_jacobians("8-connected", discount, index, None)
        d_q, q = (each[NAMES.index(name)] for each in forward[1:])
        policy = scipy.special.softmax(BETA * q, axis=-1)
        for s, a in zip(*(np.asarray(x)[demos.task == index] for x in (demos.states, demos.actions)), strict=True):
            expected += BETA * (d_q[s, a] - policy[s] @ d_q[s])
    assert relative_error(jax.jit(jax.grad(likelihood))(theta), expected) < CLOSE
