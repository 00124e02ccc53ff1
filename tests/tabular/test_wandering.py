"""The warning of log-sum-exp agents that avoid their goal, at the boundary that a closed form has."""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import sidestep as ss

BETA, DISCOUNT, ACTIONS = 2.0, 0.9, 3
BOUNDARY = np.log(ACTIONS) / (BETA * (1 - DISCOUNT))
"""What a goal must pay at least."""
SOFT = ss.Behavior("logsumexp", BETA)
AVOIDS = "agents of task {} avoid its goal: for a log-sum-exp agent with β = {:g} at γ = {:g}"


def tiny(actions: int = ACTIONS) -> ss.TabularModel:
    """Action 0 of state 0 leads to the goal, state 1; the others stay."""
    after = np.array([[[1], *[[0]] * (actions - 1)], [[1]] * actions])
    return ss.TabularModel(ss.graph(after), jnp.zeros((2, actions, 1)))


def paying(goal: float, cost: float = 0.0, discount: float = DISCOUNT) -> ss.Task:
    return ss.task(np.array([-cost, goal]), discount, np.array([False, True]))


def warned(call) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        call()
    return [str(each.message) for each in caught if issubclass(each.category, ss.SidestepWarning)]


def chance_of_arriving(goal: float, cost: float) -> float:
    """π(arrive) = exp β(γG − c − V), with V = (1/β) log(exp β(γG − c) + (n − 1) exp β(γV − c)) by a root search."""

    def excess(value):
        odds = np.exp(BETA * (DISCOUNT * goal - cost - value))
        return odds + (ACTIONS - 1) * np.exp(BETA * (DISCOUNT * value - cost - value)) - 1

    value: Any = brentq(excess, -100, 100, xtol=1e-14)
    return float(np.exp(BETA * (DISCOUNT * goal - cost - value)))


@pytest.mark.parametrize("cost", [0.0, 0.3])
@pytest.mark.parametrize("factor", [0.2, 0.9, 0.98, 1.02, 1.5])
def test_solve_warns_exactly_where_agents_arrive_less_often_than_by_chance(factor, cost):
    """The goal pays a factor of (log(n)/β − c)/(1 − γ): below 1, agents avoid it."""
    goal = factor * (BOUNDARY - cost / (1 - DISCOUNT))
    texts = warned(lambda: ss.solve(tiny(), paying(goal, cost), SOFT))
    assert (chance_of_arriving(goal, cost) < 1 / ACTIONS) == (factor < 1)
    assert len(texts) == (factor < 1)
    assert all(text.startswith(AVOIDS.format(0, BETA, DISCOUNT)) for text in texts)


def test_solve_where_the_goal_pays_a_tenth_of_the_boundary_warns_of_agents_that_almost_never_arrive():
    """π(arrive) is about exp(−β(W − γG)), with W = log(n − 1)/(β(1 − γ)) that of going on for ever."""
    goal, endless = BOUNDARY / 10, np.log(ACTIONS - 1) / (BETA * (1 - DISCOUNT))
    arriving = chance_of_arriving(goal, 0.0)
    np.testing.assert_allclose(np.log(arriving), -BETA * (endless - DISCOUNT * goal), rtol=0.02)
    assert arriving < 0.003
    assert len(warned(lambda: ss.solve(tiny(), paying(goal), SOFT))) == 1


@pytest.mark.parametrize(("factor", "expected"), [(0.98, 0), (1.02, 1)])
def test_solve_of_a_grid_warns_where_one_over_beta_is_above_the_boundary(factor, expected):
    """V is 1 in all cells at log(4)/(β(1 − γ)) = 1, whatever the map."""
    grid = ss.Grid.unknown(3, 4)
    model, goal = ss.ObstacleGrid(grid), ss.reach(grid, 5, discount=0.95)
    beta = np.log(4) / (1 - 0.95) / factor
    texts = warned(lambda: ss.solve(model, goal, ss.Behavior("logsumexp", beta)))
    assert len(texts) == expected
    at_boundary = ss.Behavior("logsumexp", np.log(4) / (1 - 0.95))
    np.testing.assert_allclose(ss.solve(model, goal, at_boundary).values, 1.0, rtol=1e-6)


@pytest.mark.parametrize("backup", ["mellowmax", "max", "boltzmann"])
def test_solve_with_another_backup_warns_not(backup):
    assert not warned(lambda: ss.solve(tiny(), paying(0.01), ss.Behavior(backup, BETA)))


def test_solve_with_a_horizon_or_under_jit_warns_not():
    assert not warned(lambda: ss.solve(tiny(), paying(0.01), SOFT, options=ss.SolveOptions(horizon=3)))
    assert not warned(lambda: jax.jit(ss.solve)(tiny(), paying(0.01), SOFT))


def test_solve_of_stages_that_surely_end_warns_not():
    """Two choices, whatever they are, end the task: a value above the goal's is no reason to avoid it."""
    after = np.array([[[1], [2]], [[3], [3]], [[3], [3]], [[3], [3]]])
    model = ss.TabularModel(ss.graph(after), jnp.zeros((4, 2, 1)))
    goal = ss.task(np.array([0.0, 0, 0, 0.1]), DISCOUNT, np.arange(4) == 3)
    assert not warned(lambda: ss.solve(model, goal, SOFT))


def test_solve_of_a_corridor_that_agents_avoid_warns():
    """From state 1 agents surely arrive, so they avoid state 1."""
    after = np.array([[[1], [0], [0]], [[2], [2], [2]], [[2], [2], [2]]])
    model = ss.TabularModel(ss.graph(after), jnp.zeros((3, 3, 1)))
    goal = ss.task(np.array([0.0, 0, 1.0]), DISCOUNT, np.arange(3) == 2)
    assert len(warned(lambda: ss.solve(model, goal, SOFT))) == 1


def test_solve_where_agents_without_entropy_avoid_the_end_warns_not():
    """Going on pays, or the end costs: that is what the task says, and no fault of entropy."""
    assert not warned(lambda: ss.solve(tiny(), paying(1.0, cost=-0.2), SOFT))
    assert not warned(lambda: ss.solve(tiny(), paying(-1.0), SOFT))


def test_solve_of_a_goal_beside_a_pit_warns_by_the_goal():
    """State 1 is the goal, state 2 a pit, which agents rightly avoid."""
    after = np.array([[[1], [2], [0]], [[1]] * 3, [[2]] * 3])
    model = ss.TabularModel(ss.graph(after), jnp.zeros((3, 3, 1)))
    ends = np.arange(3) > 0
    for goal, count in ((2 * BOUNDARY, 0), (BOUNDARY / 4, 1)):
        task = ss.task(np.array([0.0, goal, -5.0]), DISCOUNT, ends)
        assert len(warned(lambda task=task: ss.solve(model, task, SOFT))) == count


def test_solve_of_rewards_of_outcomes_warns_as_of_a_goal_that_pays():
    """R(s, a, s′) = γG on arrival, and nothing at the end, is the same to agents."""
    for factor, count in ((0.98, 1), (1.02, 0)):
        rewards = np.zeros((2, ACTIONS, 2))
        rewards[0, 0, 1] = DISCOUNT * factor * BOUNDARY
        goal = ss.task(rewards, DISCOUNT, np.array([False, True]), world=tiny().graph)
        assert len(warned(lambda goal=goal: ss.solve(tiny(), goal, SOFT))) == count


def test_solve_of_actions_that_are_not_available_counts_the_others():
    """Of three actions two are available: the boundary is at log(2)."""
    model: Any = tiny()
    world = ss.graph(np.asarray(model.graph.successors), available=[[True, True, False], [True] * 3])
    model = ss.TabularModel(world, jnp.zeros((2, ACTIONS, 1)))
    for factor, count in ((0.98, 1), (1.02, 0)):
        goal = paying(factor * np.log(2) / (BETA * (1 - DISCOUNT)))
        assert len(warned(lambda goal=goal: ss.solve(model, goal, SOFT))) == count


def test_solve_of_several_tasks_names_the_first_that_is_avoided():
    tasks = ss.stack_tasks([paying(2 * BOUNDARY), paying(BOUNDARY / 2), paying(BOUNDARY / 3)])
    (text,) = warned(lambda: ss.solve(tiny(), tasks, SOFT))
    assert text.startswith(AVOIDS.format(1, BETA, DISCOUNT))


@pytest.mark.parametrize(("terms", "count"), [(("actions",), 1), (("transitions",), 0)])
def test_fit_warns_once_of_agents_that_avoid_their_goal(terms, count):
    walk = ss.Trajectory(np.array([0, 0, 1]), np.array([1, 0]), 0)
    tasks = [paying(2 * BOUNDARY), paying(BOUNDARY / 2)]
    shown = ss.gather([walk, ss.Trajectory(walk.states, walk.actions, 1)], tasks)
    texts = warned(lambda: ss.fit(tiny(), shown, SOFT, terms=terms))
    assert len(texts) == count
    assert all(text.startswith(AVOIDS.format(1, BETA, DISCOUNT)) for text in texts)


def test_fit_with_a_beta_of_each_person_warns_of_that_of_the_task():
    """Task 1 is that of person 0, who starts at the same β and has the walks to a poor goal."""
    walk = ss.Trajectory(np.array([0, 0, 1]), np.array([1, 0]), 0)
    tasks = [paying(2 * BOUNDARY), paying(BOUNDARY / 50)]
    shown = ss.gather([walk, ss.Trajectory(walk.states, walk.actions, 1)], tasks)
    behavior = ss.behavior_model(SOFT, person=[1, 0])
    fits = []
    texts = warned(lambda: fits.append(ss.fit(tiny(), shown, behavior, terms=("actions",))))
    beta = float(fits[0].behavior.betas(2)[1])
    assert [text.startswith(AVOIDS.format(1, float(f"{beta:.3g}"), DISCOUNT)) for text in texts] == [True]
