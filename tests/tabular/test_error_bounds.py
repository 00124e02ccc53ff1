"""Bounds of values' errors where a few states are nearly closed: these take most of the moves to the end."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.problems import BACKUPS, plain_backup, plain_policy, solve_with
from sidestep.tabular.backups import Behavior
from sidestep.tabular.graph import graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid, tabular_model
from sidestep.tabular.solvers.base import BellmanEquation, DecisionProcess
from sidestep.tabular.solvers.bound_kernels import bound_by_potential
from sidestep.tabular.solvers.bounds import error_bound, move_costs
from sidestep.tabular.solvers.gauss_seidel import KERNELS, GaussSeidel
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.solvers.native import HostProcess, NativeBackup
from sidestep.tabular.solvers.ordering import number_process
from sidestep.tabular.tasks import reach, task

PARTS, SIZE, ACTIONS, BETA = 100, 11, 3, 8.0
STATES = PARTS * SIZE
TERMINAL = np.tile(np.arange(SIZE) == 0, PARTS)
CONVEX = [name for name in BACKUPS if name != "Boltzmann"]
SOLVERS = {"Jacobi": Jacobi, "Gauss-Seidel": GaussSeidel}
each_convex_backup = pytest.mark.parametrize("backup", CONVEX)
each_solver = pytest.mark.parametrize("solver", SOLVERS)


class World(NamedTuple):
    """A process of many small parts without a way from one to another, the first state of each terminal.

    The last outcome of each action is that it fails. `moves` are the others as M[part, s, a, s'].
    """

    successors: np.ndarray
    probabilities: np.ndarray
    reward: np.ndarray
    moves: np.ndarray


def random_world(seed: int) -> World:
    """Parts in which every hundredth state is left with a probability of 1e-7 to 1e-2."""
    rng = np.random.default_rng(seed)
    inside = rng.integers(0, SIZE, (PARTS, SIZE, ACTIONS, 2))
    inside[:, :, 0, 0] = np.maximum(np.arange(SIZE) - 1, 0)
    chance = 10.0 ** np.where(rng.random((PARTS, SIZE)) < 0.01, rng.uniform(-7, -2, (PARTS, SIZE)), 0)
    leaving = chance[..., None, None] * rng.dirichlet(np.ones(3), (PARTS, SIZE, ACTIONS))[..., :2]
    moves = np.einsum("psak,psakt->psat", leaving, np.eye(SIZE)[inside])
    here = np.broadcast_to(np.arange(SIZE)[:, None, None], (PARTS, SIZE, ACTIONS, 1))
    successors = np.concatenate([inside, here], axis=-1) + SIZE * np.arange(PARTS)[:, None, None, None]
    probabilities = np.concatenate([leaving, 1 - leaving.sum(axis=-1, keepdims=True)], axis=-1)
    reward = -rng.uniform(0.5, 2, (PARTS, SIZE, ACTIONS))
    # an outcome that leads back to its own state is one more that fails
    moves[:, np.arange(SIZE), :, np.arange(SIZE)] = 0
    shape = STATES, ACTIONS, 3
    return World(successors.reshape(shape), probabilities.reshape(shape), reward.reshape(shape[:2]), moves)


def reference(backup: str, world: World, discount: float) -> np.ndarray:
    """V by Newton's method on all equations of a part at once, from that of action 0; by differences of values."""
    live, reward = np.arange(SIZE) > 0, world.reward.reshape(PARTS, SIZE, ACTIONS)
    values, weights = np.zeros((PARTS, SIZE)), np.zeros((PARTS, SIZE, ACTIONS))
    weights[..., 0] = 1
    for step in range(60):
        differences = values[:, None, None] - values[:, :, None, None]
        advantages = reward + discount * (world.moves * differences).sum(-1) - (1 - discount) * values[..., None]
        gain = (weights * advantages).sum(-1)
        if step > 0:
            gain = np.asarray(plain_backup(backup, jnp.asarray(advantages), BETA))
            weights = np.asarray(plain_policy(jnp.asarray(advantages), BETA))
            if backup == "hard max":
                weights = np.eye(ACTIONS)[advantages.argmax(axis=-1)]
        outward = discount * np.einsum("psa,psat->pst", weights, world.moves) * live[:, None]
        stay = np.where(live, outward.sum(-1) + 1 - discount, 1)
        matrix = np.eye(SIZE) * stay[..., None] - outward
        values = values + np.linalg.solve(matrix, (gain * live)[..., None])[..., 0]
    return values.ravel()


def equation_of(backup: str, world: World, discount: float) -> BellmanEquation:
    process = DecisionProcess(
        successors=jnp.asarray(world.successors),
        probabilities=jnp.asarray(world.probabilities),
        reward=jnp.asarray(world.reward),
        terminal_reward=jnp.zeros(1),
        terminal=jnp.asarray(TERMINAL),
        available=jnp.ones((1, 1), bool),
        discount=jnp.asarray(discount),
    )
    return BellmanEquation(process, BACKUPS[backup], jnp.asarray(BETA))


def bound_in_jax(equation: BellmanEquation, values: np.ndarray) -> float:
    """The bound where the change says nothing."""
    costs, nothing = move_costs(*equation), jnp.asarray(0.0)
    return float(jax.jit(error_bound)(equation, costs, jnp.asarray(values), jnp.asarray(1e300), nothing))


def bound_on_host(equation: BellmanEquation, values: np.ndarray) -> float:
    """The same by native code, the states numbered at random."""
    order = np.random.default_rng(0).permutation(STATES).astype(np.int32)
    given = equation.process
    host = HostProcess(
        successors=np.asarray(given.successors),
        probabilities=np.asarray(given.probabilities),
        reward=np.asarray(given.reward),
        terminal_reward=np.asarray(given.terminal_reward),
        terminal=np.asarray(given.terminal),
        available=np.asarray(given.available),
        discount=np.float64(given.discount),
    )
    process, _ = number_process(host, order, np.argsort(order).astype(np.int32), np.ones(STATES, bool))
    backup = NativeBackup(KERNELS[type(equation.backup)], np.float64(BETA), np.float64(4e-12))
    costs, positions = move_costs(*equation), np.arange(STATES, dtype=np.int32)
    return bound_by_potential(process, backup, costs, values[order], positions)


@each_convex_backup
@pytest.mark.parametrize("bound", [bound_in_jax, bound_on_host])
@pytest.mark.parametrize("discount", [1.0, 0.999])
def test_error_bound_of_values_that_are_off_is_no_less_than_their_error(backup, bound, discount):
    """Off by a multiple of the potential: then half the bound would be too small; and off at random."""
    world, rng = random_world(1), np.random.default_rng(2)
    exact, equation = reference(backup, world, discount), equation_of(backup, world, discount)
    costs = move_costs(*equation)
    potential = np.log1p(-exact / float(costs.least))
    spread = rng.choice([-1.0, 0.0, 1.0], PARTS).repeat(SIZE)
    for size, direction in ((1e-4, 1.0), (1e-4, -1.0), (1e-2, -1.0), (1e-3, spread)):
        values = exact + size * direction * potential
        error = np.abs(values - exact).max()
        assert error <= bound(equation, values) <= 6 * error
    for values in (exact * (1 + 1e-8 * rng.normal(size=STATES)), exact + 1e-3 * rng.normal(size=STATES) * ~TERMINAL):
        assert np.abs(values - exact).max() <= bound(equation, values)


@each_convex_backup
@each_solver
def test_solution_error_beside_nearly_closed_states_bounds_that_of_a_loose_solve(backup, solver):
    world = random_world(1)
    exact = reference(backup, world, 1.0)
    model = tabular_model(graph(world.successors), world.probabilities)
    ended = task(world.reward, 1.0, TERMINAL)
    solution = solve_with(SOLVERS[solver](tolerance=1e-4), model, ended, Behavior(BACKUPS[backup], BETA))
    assert bool(solution.converged)
    assert np.abs(np.asarray(solution.values) - exact).max() <= solution.error
    assert solution.error <= 1e-2 * np.abs(exact).max()


@each_solver
def test_solve_in_32_bits_of_a_room_with_a_nearly_closed_cell_converges(solver):
    """The four cells around one are entered with probability 1e-5, so that it is worth −25,000; others −50."""
    grid = Grid.unknown(40, 40)
    logits = np.full((40, 40), -4.0, np.float32)
    logits[[19, 21, 20, 20], [20, 20, 19, 21]] = 11.5
    behavior = Behavior(BACKUPS["log-sum-exp"], 10.0)
    single, double = (
        solve_with(SOLVERS[solver](), ObstacleGrid(grid, jnp.asarray(logits.ravel(), dtype)), goal, behavior)
        for dtype in (jnp.float32, jnp.float64)
        for goal in [reach(grid, 0, discount=1.0, step_cost=1.0)]
    )
    assert single.values.dtype == jnp.float32
    assert float(double.values.min()) < -2e4
    assert bool(single.converged)
    assert np.abs(np.asarray(single.values, np.float64) - np.asarray(double.values)).max() <= single.error
    assert single.error < 10
