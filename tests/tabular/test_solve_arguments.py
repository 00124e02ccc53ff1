"""What `solve` refuses: states, times and regions that do not exist, and models without distributions."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sidestep as ss

WORLD = ss.graph(np.array([[[0, 1], [1, 1]], [[1, 1], [0, 1]]]))
TASK, BEHAVIOR = ss.task(-np.ones((2, 2)), 0.9, np.arange(2) == 1), ss.Behavior("max")
MODEL = ss.tabular_model(WORLD, [[[0.5, 0.5], [0.0, 1.0]], [[1.0, 0.0], [0.5, 0.5]]])
UNTIMED = "'times': expected none without visited states and a deadline"
DEADLINE = ss.SolveOptions(horizon=2, deadline=True)


def solved(**settings) -> ss.Solution:
    return ss.solve(MODEL, TASK, BEHAVIOR, **settings)


@pytest.mark.parametrize(("settings", "match"), [
    ({"visited": np.array([2])}, r"'visited': expected states in 0…1, found 2"),
    ({"visited": np.array([-1])}, r"'visited': expected states in 0…1, found -1"),
    ({"visited": np.array([[0]])}, "'visited'"),
    ({"times": np.array([0])}, UNTIMED),
    ({"visited": np.array([0]), "times": np.array([0])}, UNTIMED),
    ({"visited": np.array([0]), "times": np.array([2]), "options": DEADLINE}, "'times': expected .* 0…1, found 2"),
    ({"visited": np.array([0]), "times": np.array([0, 1]), "options": DEADLINE}, "'times'"),
    ({"visited": np.array([0]), "times": np.array([0]), "options": ss.SolveOptions(horizon=2)}, UNTIMED),
    ({"region": np.ones(3, bool)}, "'region'"),
])  # fmt: skip
def test_solve_of_states_that_do_not_exist_is_refused(settings, match):
    with pytest.raises(ss.InputError, match=match):
        solved(**settings)


@pytest.mark.parametrize("solver", [ss.Jacobi(), ss.GaussSeidel()], ids=["Jacobi", "GaussSeidel"])
def test_solve_of_some_states_has_their_action_values(solver):
    options, some = ss.SolveOptions(solver=solver), np.array([1, 0, 0])
    every = solved(options=options)
    np.testing.assert_array_equal(solved(visited=some, options=options).action_values, every.action_values[some])


def test_solve_of_some_states_at_their_times_has_the_action_values_then():
    late = solved(visited=np.array([0, 0]), times=np.array([0, 1]), options=DEADLINE)
    np.testing.assert_allclose(late.action_values, [[-1 - 0.9 / 2, -1], [-1, -1]], rtol=1e-12)


class OwnModel(ss.TransitionModel):
    """A model of one's own: all outcomes are equally probable, times a factor."""

    graph: ss.Graph
    parameters: jax.Array
    factor: float = eqx.field(static=True, default=1.0)
    outcomes: int = eqx.field(static=True, default=2)

    def probabilities(self):
        chance = self.factor * jax.nn.sigmoid(self.parameters) * 2 / self.outcomes
        return jnp.broadcast_to(chance, (2, 2, self.outcomes))


def test_solve_of_a_model_of_ones_own_checks_its_probabilities():
    half = OwnModel(WORLD, jnp.zeros(()), 0.5)
    np.testing.assert_allclose(ss.solve(OwnModel(WORLD, jnp.zeros(())), TASK, BEHAVIOR).values, [-1, 0])
    with pytest.raises(
        ss.InputError, match=r"state 0, action 0.*expected probabilities that sum to 1, found a sum of 0\.5"
    ):
        ss.solve(half, TASK, BEHAVIOR)
    with pytest.raises(ss.InputError, match=r"'model': expected probabilities of shape \(2, 2, 2\), found \(2, 2, 3\)"):
        ss.solve(OwnModel(WORLD, jnp.zeros(()), outcomes=3), TASK, BEHAVIOR)
    with pytest.raises(ss.InputError, match=r"found a sum of 0\.5"):
        ss.fit(half, ss.gather([ss.Trajectory(np.array([0, 1]), np.array([1]), 0)], [TASK]), BEHAVIOR)
