"""Lattices: interpolation, the tabular approximation of a continuous world, and values in closed form."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sidestep as ss
import sidestep.continuous as sc
from sidestep.tabular import solve as solver

RANDOM, SOFT = np.random.default_rng(0), ss.Behavior(ss.LogSumExp(), 2.0)
BOX = sc.Lattice(jnp.asarray([-1.0, 2.0]), jnp.asarray([2.0, 4.0]), (4, 3))
RING = sc.Lattice(jnp.asarray([-np.pi]), jnp.asarray([np.pi]), (8,), (True,))
CYLINDER = sc.Lattice(jnp.asarray([-np.pi, -8.0]), jnp.asarray([np.pi, 8.0]), (12, 9), (True, False))


tabular_model = eqx.filter_jit(sc.LatticePlanner.tabular_model)
action_values = eqx.filter_jit(sc.LatticePlanner.action_values)
solve = eqx.filter_jit(solver.solve)


@eqx.filter_jit
def weights_at(lattice, places):
    return jax.vmap(lattice.interpolation_weights)(places)


@eqx.filter_jit
def interpolate(lattice, values, places):
    return jax.vmap(lattice.interpolate, (None, 0))(values, places)


def scattered(lattice, count=200, beyond=1.0):
    """Places in and around a lattice."""
    return jnp.asarray(RANDOM.uniform(lattice.low - beyond, lattice.high + beyond, (count, len(lattice.counts))))


# Points and weights


def test_points_last_side_runs_fastest():
    np.testing.assert_allclose(BOX.points(), [[x, y] for x in (-1, 0, 1, 2) for y in (2, 3, 4)])
    assert BOX.size == 12
    np.testing.assert_allclose(RING.points()[:, 0], -np.pi + np.arange(8) * np.pi / 4)


@pytest.mark.parametrize("lattice", [BOX, RING, CYLINDER])
def test_interpolation_weights_add_up_to_one(lattice):
    points, weights = weights_at(lattice, scattered(lattice))
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-12)
    assert (np.asarray(weights) >= 0).all()
    assert ((np.asarray(points) >= 0) & (np.asarray(points) < lattice.size)).all()
    values = jnp.asarray(RANDOM.normal(size=lattice.size))
    np.testing.assert_allclose(interpolate(lattice, values, lattice.points()), values, atol=1e-12)


def test_interpolate_bilinear_function_is_exact_inside():
    """Outside the corners, values are those at the border."""
    places = scattered(BOX)
    inside = np.clip(places, BOX.low, BOX.high)
    assert (inside != places).any(axis=1).mean() > 0.3

    def function(x, y):
        return 3 - 2 * x + 0.5 * y + x * y

    values = function(*BOX.points().T)
    np.testing.assert_allclose(interpolate(BOX, values, places), function(*inside.T), atol=1e-12)


def test_interpolate_periodic_side_closes():
    values = RANDOM.normal(size=8)
    angles = np.append(RANDOM.uniform(-20, 20, 200), [np.pi, -np.pi, np.nextafter(np.pi, 4), np.nextafter(-np.pi, -4)])
    expected = np.interp(angles, RING.points()[:, 0], values, period=2 * np.pi)
    found = interpolate(RING, jnp.asarray(values), jnp.asarray(angles[:, None]))
    np.testing.assert_allclose(found, expected, atol=1e-9)


# Transitions


def dense(model):
    probabilities = model.probabilities()
    return jnp.einsum("sak,sakt->sat", probabilities, jnp.eye(model.graph.states)[model.graph.successors])


WALL = sc.Walls(low=jnp.asarray([[0.2, 2.0]]), high=jnp.asarray([[0.8, 3.0]]))
MOVES = jnp.asarray([[1.0, 0.0], [0.0, -1.0], [-1.0, 1.0]])


@pytest.mark.parametrize(("dynamics", "lattice", "actions"), [
    (sc.Pendulum(), CYLINDER, jnp.asarray([[-2.0], [0.0], [2.0]])),
    (sc.ObstacleMotion(WALL, BOX.low, BOX.high, jnp.full(2, 0.1)), BOX, MOVES / 3),
])  # fmt: skip
def test_tabular_model_probabilities_add_up_and_keep_the_mean(dynamics, lattice, actions):
    model = tabular_model(sc.LatticePlanner(dynamics, actions, SOFT, lattice))
    transitions = np.asarray(dense(model))
    np.testing.assert_allclose(transitions.sum(axis=-1), 1, atol=1e-12)
    here = lattice.size // 2 + 1
    log_probabilities, means = dynamics.outcomes(lattice.points()[here], actions[0])
    np.testing.assert_allclose(transitions[here, 0] @ lattice.points(), np.exp(log_probabilities) @ means, atol=1e-12)


def test_tabular_model_of_dynamics_that_return_nan_raises():
    nan = jax.tree.map(lambda leaf: leaf * jnp.nan, WALKER.dynamics.parameters)
    with pytest.raises(ss.InputError, match="expected a possible outcome of every action"):
        replace(WALKER, dynamics=WALKER.dynamics.with_parameters(nan)).tabular_model()


def test_tabular_model_outcomes_on_points_are_exact():
    """Moves of one step that are stopped by a field: the target or the place itself, and never outside."""
    field = sc.RadialField(jnp.asarray([1.0, -2.0]), jnp.asarray([[-1.0, 2.0], [2.0, 4.0]]), 1.0)
    motion = sc.ObstacleMotion(field, BOX.low, BOX.high, jnp.full(2, 0.1))
    transitions = np.asarray(dense(tabular_model(sc.LatticePlanner(motion, MOVES, SOFT, BOX))))
    points = np.asarray(BOX.points())
    expected = np.zeros_like(transitions)
    for state, place in enumerate(points):
        for action, move in enumerate(np.asarray(MOVES)):
            target = np.clip(place + move, BOX.low, BOX.high)
            nearer, farther = (np.sum((target - center) ** 2) for center in np.asarray(field.centers))
            weight = 1 / (1 + np.exp((nearer - farther) / 2))
            blocked = 1 / (1 + np.exp(-(1.0 * weight - 2.0 * (1 - weight))))
            expected[state, action, np.flatnonzero((points == target).all(axis=1))[0]] += 1 - blocked
            expected[state, action, state] += blocked
    np.testing.assert_allclose(transitions, expected, atol=1e-12)


# Values


WALK = sc.LinearGaussian(jnp.eye(1), jnp.eye(1), jnp.full(1, 0.1))
LINE = sc.Lattice(jnp.zeros(1), jnp.full(1, 9.0), (10,))
WALKER = sc.LatticePlanner(WALK, jnp.asarray([[-1.0], [1.0]]), SOFT, LINE)


def test_solve_corridor_with_step_cost_matches_closed_form():
    """With β = 2, Z = exp βV solves Z(k) = e⁻² (Z(k − 1) + Z(k + 1)), Z(0) = 1 and, at the far end, Z(10) = Z(9).

    So Z(k) ∝ xᵏ + x¹⁹⁻ᵏ with x = e⁻² (1 + x²).
    """
    task = WALKER.tabular_task(sc.reach_region((0.0,), 0.5, discount=1.0, step_cost=1.0))
    solution = solve(tabular_model(WALKER), task, SOFT)
    x = (1 - np.sqrt(1 - 4 * np.exp(-4))) / (2 * np.exp(-2))
    steps = np.arange(10)
    expected = np.log((x**steps + x ** (19 - steps)) / (1 + x**19)) / 2
    assert bool(solution.converged)
    np.testing.assert_allclose(solution.values, expected, atol=1e-8)


@pytest.mark.parametrize("stride", [1.0, 0.5])
def test_solve_corridor_with_goal_reward_matches_closed_form(stride):
    """Strides of a whole step are worth γᵏ; of half a step, x̄ = γ (x̄ + 1)/2 a point, for values are interpolated."""
    goal, walker = sc.reach_region((0.0,), 0.25, discount=0.9), replace(WALKER, actions=stride * WALKER.actions)
    solution = solve(tabular_model(walker), walker.tabular_task(goal), ss.Behavior(ss.HardMax()))
    rate = 0.9 if stride == 1 else 0.45 / 0.55
    np.testing.assert_allclose(solution.values, rate ** np.arange(10), atol=1e-8)
    q = jax.vmap(lambda place: action_values(walker, goal, solution.values, place))(LINE.points())
    np.testing.assert_allclose(q[1:], solution.action_values[1:], atol=1e-8)


def test_action_values_between_points_look_one_move_ahead():
    task = sc.PendulumTask(goal=jnp.zeros(()), discount=jnp.asarray(0.9))
    state, torques = jnp.asarray([0.3, 0.5]), jnp.asarray([[-1.0], [1.0]])
    values = 1 + 2 * CYLINDER.points()[:, 1]
    q = action_values(sc.LatticePlanner(sc.Pendulum(), torques, SOFT, CYLINDER), task, values, state)
    speeds = 0.5 + (15 * np.sin(0.3) + 3 * np.array([-1, 1])) * 0.05
    np.testing.assert_allclose(q, -(0.3**2) - 0.1 * 0.5**2 - 0.001 + 0.9 * (1 + 2 * speeds), atol=1e-12)


# Refusals


@pytest.mark.parametrize(
    ("low", "high"), [([0, 0], [1, 0]), ([0, 2], [1, 1]), ([0, 0], [1, np.inf]), ([np.nan, 0], [1, 1])]
)
def test_lattice_corners_out_of_order_or_not_finite_are_refused(low, high):
    with pytest.raises(ss.InputError, match=r"'low, high': expected corners in order|expected finite numbers, found"):
        sc.Lattice(jnp.asarray(low, float), jnp.asarray(high, float), (2, 2))


@pytest.mark.parametrize(("counts", "periodic"), [((1, 2), None), ((2,), None), ((2, 2, 2), None), ((2, 2), (True,))])
def test_lattice_fewer_than_two_points_a_side_are_refused(counts, periodic):
    with pytest.raises(ss.InputError, match=r"expected (numbers of points|booleans)(, at least 2| of shape \(2,\))"):
        sc.Lattice(jnp.zeros(2), jnp.ones(2), counts, periodic)
