"""Random Markov decision processes of every kind beside a dense reference that is written out here.

States have different sets of available actions, actions different outcomes, rewards depend on what follows, there are
several terminal states with rewards of their own; at discount 1 some states have no way out, and some actions may lead
there. All arrays have one shape, so each solver is compiled once for each backup.
"""

from functools import cache
from itertools import product
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from helpers.problems import BACKUPS, plain_backup
from sidestep.tabular.backups import Behavior
from sidestep.tabular.graph import Graph
from sidestep.tabular.models import TabularModel
from sidestep.tabular.solve import SolveOptions, solve
from sidestep.tabular.solvers.gauss_seidel import GaussSeidel
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import Task

STATES, ACTIONS, OUTCOMES, BETA = 7, 3, 3, 4.0
SOLVERS = {"Jacobi": Jacobi(tolerance=1e-12), "Gauss-Seidel": GaussSeidel(tolerance=1e-12)}
LOOSE = 1e-3
LOOSE_SOLVERS = {"Jacobi": Jacobi(tolerance=LOOSE), "Gauss-Seidel": GaussSeidel(tolerance=LOOSE)}
SWEEPS = 3_000
each_backup = pytest.mark.parametrize("backup", BACKUPS)
each_solver = pytest.mark.parametrize("solver", SOLVERS)


class Numbers(NamedTuple):
    """What values depend on."""

    logits: jax.Array
    reward: jax.Array
    outcome_reward: jax.Array
    terminal_reward: jax.Array
    beta: jax.Array


class World(NamedTuple):
    """A random process."""

    successors: jax.Array
    possible: jax.Array
    available: jax.Array
    terminal: jax.Array
    discount: jax.Array
    numbers: Numbers


def random_world(seed: int, discount: float) -> World:
    rng = np.random.default_rng(seed)
    shape = STATES, ACTIONS, OUTCOMES
    successors = rng.integers(0, STATES, shape)
    possible = rng.random(shape) < 0.6
    possible[..., 0] |= ~possible.any(axis=-1)
    available = rng.random(shape[:2]) < 0.7
    available[:, 0] |= ~available.any(axis=-1)
    terminal = np.zeros(STATES, bool)
    terminal[rng.choice(STATES, rng.integers(1, 3), replace=False)] = True
    numbers = Numbers(
        jnp.asarray(rng.normal(size=shape)),
        jnp.asarray(rng.uniform(-1.5, -0.7, shape[:2])),
        jnp.asarray(rng.uniform(-0.2, 0.2, shape)),
        jnp.asarray(rng.normal(size=STATES)),
        jnp.asarray(BETA),
    )
    arrays = [jnp.asarray(part) for part in (successors, possible, available, terminal, discount)]
    return World(arrays[0], arrays[1], arrays[2], arrays[3], arrays[4], numbers)


def states_with_a_proper_policy(world: World) -> set[int]:
    """By the definition: the largest set from which the end is reached by actions that surely stay in the set."""
    successors, possible, available = (np.asarray(part) for part in world[:3])
    leads_to = {
        (s, a): set(successors[s, a][possible[s, a]].tolist())
        for s, a in product(range(STATES), range(ACTIONS))
        if available[s, a]
    }
    ends = set(np.flatnonzero(world.terminal).tolist())
    inside = set(range(STATES))
    while True:
        reached = set(ends)
        for _ in range(STATES):
            reached |= {s for (s, _), after in leads_to.items() if s in inside and after <= inside and after & reached}
        if reached == inside:
            return inside
        inside = reached


class Mask(NamedTuple):
    """What of a world is finite."""

    states: np.ndarray
    actions: np.ndarray


def mask_of(world: World) -> Mask:
    """All is finite but for actions that are not available, and at discount 1 what has no proper policy."""
    successors, possible, available = (np.asarray(part) for part in world[:3])
    states, actions = np.ones(STATES, bool), available.copy()
    if world.discount == 1:
        states = np.isin(np.arange(STATES), list(states_with_a_proper_policy(world)))
        actions &= (states[successors] | ~possible).all(axis=-1)
    return Mask(states, actions)


def dense_values(backup: str, world: World, mask: Mask, numbers: Numbers):
    """(V, Q) by plain value iteration on dense arrays: Q = Σ T (R + γ V); 0 where the value is infinite."""
    odds = jnp.where(world.possible, jnp.exp(numbers.logits), 0)
    probabilities = odds / odds.sum(axis=-1, keepdims=True)
    transitions = jnp.einsum("sak,sakt->sat", probabilities, jnp.eye(STATES)[world.successors])
    paid = numbers.reward + jnp.sum(probabilities * numbers.outcome_reward, axis=-1)
    live = mask.states & ~world.terminal
    usable = jnp.where(live[:, None], mask.actions, True)
    # the mellowmax counts available actions, whether they are usable or not
    lost = jnp.log(jnp.where(live, world.available.sum(axis=1) / usable.sum(axis=1), 1)) / numbers.beta
    lost = lost if backup == "mellowmax" else 0

    def q_of(values):
        return jnp.where(usable, paid + world.discount * jnp.einsum("sat,t->sa", transitions, values), 0)

    def ended(values):
        return jnp.where(world.terminal, numbers.terminal_reward, jnp.where(live, values, 0))

    def sweep(values, _):
        return ended(plain_backup(backup, q_of(values), numbers.beta, usable) - lost), None

    values, _ = jax.lax.scan(sweep, ended(jnp.zeros(STATES)), length=SWEEPS)
    return values, q_of(values)


def functional(values, q, live, mask: Mask):
    """A number that depends on all finite values, and on the finite action values where actions are taken."""
    rng = np.random.default_rng(5)
    by_value, by_q = rng.normal(size=values.shape), rng.normal(size=q.shape)
    finite_q = jnp.where(mask.actions & live[:, None], q, 0)
    return jnp.sum(by_value * jnp.where(mask.states, values, 0)) + jnp.sum(by_q * finite_q)


@cache
def dense_results(backup: str):
    """A compiled function of a world: (V, Q), the functional's gradient, and central differences along a direction."""

    @jax.jit
    def results(world: World, mask: Mask, direction: Numbers):
        def total(numbers):
            return functional(*dense_values(backup, world, mask, numbers), mask.states & ~world.terminal, mask)

        def moved(step):
            return total(jax.tree.map(lambda x, d: x + step * d, world.numbers, direction))

        h = 1e-4
        difference = (8 * (moved(h) - moved(-h)) - (moved(2 * h) - moved(-2 * h))) / (12 * h)
        return dense_values(backup, world, mask, world.numbers), jax.grad(total)(world.numbers), difference

    return results


@cache
def library_results(backup: str, solver: str):
    """A compiled function of a world: the solution, and the functional's gradient."""

    @jax.jit
    def results(world: World, mask: Mask):
        def total(numbers):
            table = Graph(world.successors, jnp.ones((1, 1)), world.available)
            model = TabularModel(table, numbers.logits, world.possible)
            rewards = numbers.reward, numbers.terminal_reward, world.terminal, world.discount, numbers.outcome_reward
            behavior, options = Behavior(BACKUPS[backup], numbers.beta), SolveOptions(solver=SOLVERS[solver])
            solution = solve(model, Task(*rewards), behavior, options=options)
            live = mask.states & ~world.terminal
            return functional(solution.values, solution.action_values, live, mask), solution

        (_, solution), gradient = jax.value_and_grad(total, has_aux=True)(world.numbers)
        return solution, gradient

    return results


@each_backup
@each_solver
@settings(max_examples=12)
@given(seed=st.integers(0, 10_000), discount=st.sampled_from([0.9, 1.0]))
def test_solve_of_a_random_process_equals_the_dense_reference(backup, solver, seed, discount):
    """Values, action values, which of them are −∞, and the gradient, by differentiation and by differences."""
    world, rng = random_world(seed, discount), np.random.default_rng(seed)
    mask, direction = mask_of(world), jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), world.numbers)
    (values, q), expected, difference = dense_results(backup)(world, mask, direction)
    assume(values.min() > -50)  # value iteration would take too long
    if backup == "hard max":  # differences across a tie are no derivative
        best = np.sort(np.where(mask.actions, q, -np.inf)[mask.states & ~world.terminal], axis=1)
        assume((best[:, -1] - best[:, -2] > 0.01).all())
    solution, gradient = library_results(backup, solver)(world, mask)

    assert bool(solution.converged)
    live = mask.states & ~world.terminal
    np.testing.assert_array_equal(np.isfinite(solution.values), mask.states)
    np.testing.assert_array_equal(np.isneginf(solution.action_values)[live], ~mask.actions[live])
    close(solution.values[mask.states], values[mask.states])
    close(np.where(mask.actions, solution.action_values, 0)[live], q[live])
    for ours, theirs in zip(gradient, expected, strict=True):
        close(ours, theirs, within=1e-7)
    along = sum(float(jnp.sum(g * d)) for g, d in zip(gradient, direction, strict=True))
    assert along == pytest.approx(float(difference), rel=1e-6, abs=1e-7)


@cache
def loose_solution(backup: str, solver: str):
    """A compiled function of a world: a solution of low accuracy."""

    @jax.jit
    def solution(world: World):
        table = Graph(world.successors, jnp.ones((1, 1)), world.available)
        model = TabularModel(table, world.numbers.logits, world.possible)
        numbers = world.numbers
        rewards = numbers.reward, numbers.terminal_reward, world.terminal, world.discount, numbers.outcome_reward
        behavior = Behavior(BACKUPS[backup], numbers.beta)
        return solve(model, Task(*rewards), behavior, options=SolveOptions(solver=LOOSE_SOLVERS[solver]))

    return solution


@pytest.mark.parametrize("backup", [name for name in BACKUPS if name != "Boltzmann"])
@each_solver
@settings(max_examples=12)
@given(seed=st.integers(0, 10_000), discount=st.sampled_from([0.9, 0.99, 1.0]))
def test_solution_error_bounds_the_error_of_a_loose_solve(backup, solver, seed, discount):
    """The bound holds, and where it is too large the sweeps go on."""
    world = random_world(seed, discount)
    mask = mask_of(world)
    (values, _), _, _ = dense_results(backup)(world, mask, world.numbers)
    assume(values.min() > -50)
    solution = loose_solution(backup, solver)(world)
    error = jnp.abs(jnp.where(mask.states, solution.values - values, 0)).max()
    # the reference is rounded, too
    assert error <= float(solution.error) * (1 + 1e-6) + 1e-11 * jnp.abs(values).max()
    assert bool(solution.converged)
    assert solution.error <= jnp.sqrt(LOOSE) * jnp.abs(values).max() * (1 + 1e-6)


def close(ours, theirs, within: float = 1e-9):
    np.testing.assert_allclose(ours, theirs, rtol=within, atol=within)
