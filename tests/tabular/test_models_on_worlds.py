"""Worlds that are not obstacle grids: what their rules say, and that fits recover the rules from demonstrations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.problems import dense
from sidestep.errors import InputError
from sidestep.inference.fit import fit
from sidestep.inference.priors import Normal
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.demonstrations import gather
from sidestep.tabular.graph import Graph
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.likelihood import ALL_TERMS
from sidestep.tabular.models import ObstacleGrid, SlipperyGrid, closed, road_network, true_model, walled_grid
from sidestep.tabular.planning import plan
from sidestep.tabular.simulation import simulate
from sidestep.tabular.solve import solve
from sidestep.tabular.tasks import Task, reach
from sidestep.worlds.farm import Farm
from sidestep.worlds.gravity import DIRECTIONS, Gravity, most_probable_rule
from sidestep.worlds.rooms import rooms_in_a_row

pytestmark = pytest.mark.slow

UP, DOWN, LEFT, RIGHT = range(4)


def surely(model, state, action):
    """Where an action leads, if it surely leads somewhere."""
    chances = np.asarray(model.probabilities()[state, action])
    assert chances.max() > 1 - 1e-4
    return int(model.graph.successors[state, action, chances.argmax()])


def logit(chance):
    return np.log(chance) - np.log1p(-np.asarray(chance))


def anywhere(graph: Graph, states, discount=0.95) -> Task:
    """The task of reaching any of some states."""
    return Task(*map(jnp.asarray, ([[0.0]], [1.0], np.isin(np.arange(graph.states), states), discount)))


def recovered(world, model, tasks, starts, prior=None, beta=10.0, terms=ALL_TERMS):
    """The fit of a model to walks of optimal agents in a world, and the walks as demonstrations."""
    demos = gather(simulate(jax.random.key(0), world, tasks, starts), tasks)
    behavior = Behavior(BoltzmannAverage(), beta)
    result = fit(model, demos, behavior, prior=prior or Normal(-2.0, 4.0), terms=terms)
    assert result.converged
    return result.model, demos


# Gravity

COLORS = np.zeros((5, 5), int)
COLORS[1, 1], COLORS[1, 3], COLORS[3, 1], COLORS[3, 3], COLORS[0, 2], COLORS[4, 2] = 1, 2, 3, 4, 1, 3
RULE = np.array([UP, DOWN, LEFT, RIGHT])
FALLING = Gravity(COLORS)


def test_gravity_known_model_stops_moves_against_it_and_colors_turn_it():
    model = FALLING.known_model(RULE)
    middle = 4 * 12
    for gravity, against in zip(range(4), (DOWN, UP, RIGHT, LEFT), strict=True):
        for action, target in zip(range(4), (7, 17, 11, 13), strict=True):
            expected = middle + gravity if action == against else 4 * target + gravity
            assert surely(model, middle + gravity, action) == expected, (DIRECTIONS[gravity], action)
    assert surely(model, 4 * 5 + DOWN, RIGHT) == 4 * 6 + UP
    assert surely(model, 4 * 8 + UP, LEFT) == 4 * 7 + UP  # away from a color nothing turns
    assert surely(model, 4 * 2 + DOWN, UP) == 4 * 2 + DOWN  # nor at the border of the map
    # every color is the same everywhere
    assert surely(model, 4 * 3 + LEFT, LEFT) == 4 * 2 + UP


def test_gravity_model_at_first_has_uniform_directions():
    chances = FALLING.model().probabilities()[4 * 5 + DOWN, RIGHT]
    np.testing.assert_allclose(chances, 0.25)
    with pytest.raises(InputError, match="colors"):
        Gravity(np.zeros((2, 2), int)).model()


def test_fit_of_gravity_to_ten_demonstrations_a_goal_recovers_the_rule():
    """Optimal agents choose their colors by where these let them go."""
    world, random = FALLING.known_model(RULE), np.random.default_rng(1)
    goals = [0, 4, 20, 24]
    tasks = [anywhere(world.graph, 4 * goal + np.arange(4)) for goal in goals]
    # in some corners an agent falls for ever
    arriving = [np.flatnonzero(np.asarray(plan(world, task).solution.values) > 1e-3) for task in tasks]
    starts = [
        random.choice(np.setdiff1d(own, 4 * goal + np.arange(4)), 10) for own, goal in zip(arriving, goals, strict=True)
    ]
    learned, _ = recovered(world, FALLING.model(), tasks, starts, Normal(0.0, 2.0))
    assert most_probable_rule(learned).tolist() == RULE.tolist()


# The farm

TERRAIN = np.array([[0, 0, 1, 0, 0], [0, 0, 1, 0, 0], [0, 0, 1, 2, 2], [0, 0, 2, 0, 0], [0, 0, 2, 0, 0]])
MACHINE = np.full((5, 5), -1)
MACHINE[0, 0], MACHINE[4, 0], MACHINE[2, 0] = 0, 1, 2
ENTERS = np.array([[True, False, False], [False, True, False]])
FARM = Farm(TERRAIN, MACHINE)


def test_farm_known_model_stops_the_wrong_machine_and_swaps_machines():
    model = FARM.known_model(ENTERS)
    beside_first, beside_second = 3 * 1, 3 * 16
    assert surely(model, beside_first + 0, RIGHT) == 3 * 2 + 0
    assert surely(model, beside_first + 1, RIGHT) == beside_first + 1
    assert surely(model, beside_second + 0, RIGHT) == beside_second + 0
    assert surely(model, beside_second + 1, RIGHT) == 3 * 17 + 1
    assert surely(model, beside_first + 2, LEFT) == 3 * 0 + 0  # the first machine stands there
    assert surely(model, 3 * 0 + 2, UP) == 3 * 0 + 2  # but not by staying there
    np.testing.assert_allclose(FARM.model().probabilities()[beside_first, RIGHT], 0.5)
    with pytest.raises(InputError, match="machine"):
        Farm(np.zeros((2, 2), int), MACHINE).model()


def test_fit_of_the_farm_to_actions_of_ten_demonstrations_a_goal_recovers_what_machines_enter():
    """Optimal agents never fail to enter; that they fetch another machine shows what theirs cannot enter."""
    world, random = FARM.known_model(ENTERS), np.random.default_rng(2)
    goals = [4, 14, 24, 5]
    tasks = [anywhere(world.graph, 3 * goal + np.arange(3)) for goal in goals]
    ground = np.setdiff1d(np.flatnonzero((TERRAIN == 0) & (MACHINE < 0)), goals)
    starts = [3 * random.choice(ground[ground % 5 < 2], 10) + random.integers(3, size=10) for _ in goals]
    learned, demos = recovered(world, FARM.model(), tasks, starts, Normal(0.0, 2.0), terms=("actions",))
    assert not (demos.states == demos.next_states).any()
    assert ((np.asarray(FARM.stop_probabilities(learned)) < 0.5) == ENTERS).all()


# Walls between cells, and roads


def test_fit_of_walls_between_cells_recovers_the_wall():
    """A room of five by six; the wall runs between its third and fourth column but for the last row."""
    grid = ObstacleGrid(Grid.unknown(5, 6))
    shut = np.full(walled_grid(Grid.unknown(5, 6)).parameters.shape, -12.0)
    wall = [5 * row + 2 for row in range(4)]
    shut[wall] = 12.0
    world, random = walled_grid(Grid.unknown(5, 6), shut), np.random.default_rng(3)
    goals = [0, 5, 12, 17]
    tasks = [reach(grid.graph, goal) for goal in goals]
    starts = [random.choice(np.setdiff1d(np.arange(30), [goal]), 15) for goal in goals]
    learned, demos = recovered(world, walled_grid(Grid.unknown(5, 6)), tasks, starts)
    assert not (demos.states == demos.next_states).any()
    chances = np.asarray(closed(learned))
    assert chances[wall].min() > 0.5
    assert (np.delete(chances, wall) < 0.5).mean() > 0.95


def test_walled_grid_of_known_cells_blocks_occupied_ones():
    known = np.zeros((2, 3), int)
    known[0, 2] = 1
    model = walled_grid(Grid(known), -12.0)
    assert surely(model, 1, RIGHT) == 1  # blocked, whatever the wall before it
    assert surely(model, 0, RIGHT) == 1
    np.testing.assert_allclose(dense(model)[:2], dense(true_model(Grid(known)))[:2], atol=1e-5)
    with pytest.raises(InputError, match="connectivity"):
        walled_grid(Grid(known, connectivity=8))


def test_fit_of_a_road_network_recovers_the_closed_link():
    """A ring of eight links in both directions; link 3 is closed, so trips go around it."""
    forth = [[link, (link + 1) % 8] for link in range(8)]
    back = [[8 + (link + 1) % 8, 8 + link] for link in range(8)]
    across = [[link, 8 + (link - 1) % 8] for link in range(8)] + [[8 + link, (link + 1) % 8] for link in range(8)]
    turns = np.array(forth + back + across)
    shut = np.full(16, -12.0)
    shut[3] = 12.0
    world, random = road_network(turns, np.ones(16), shut), np.random.default_rng(0)
    goals = [4, 6, 1, 13]
    tasks = [reach(world.graph, goal) for goal in goals]
    starts = [random.choice(np.setdiff1d(np.arange(16), [goal, 3]), 12) for goal in goals]
    chances = np.asarray(closed(recovered(world, road_network(turns, np.ones(16)), tasks, starts)[0]))
    assert chances.argmax() == 3
    assert chances[3] > 0.5


def test_road_network_turns_that_do_not_exist_are_not_chosen():
    """Link 0 leads onto three links, link 1 onto the goal alone: its other two actions are no turns."""
    model = road_network(np.array([[0, 1], [0, 2], [0, 3], [1, 3], [2, 0]]), np.array([3.0, 1.0, 5.0, 0.5]), -20.0)
    behavior = Behavior(BoltzmannAverage(), 2.0)
    result = solve(model, reach(model.graph, 3, discount=1.0, step_cost=1.0), behavior)
    assert result.converged
    np.testing.assert_allclose(result.values[1], -0.5, atol=1e-6)
    np.testing.assert_allclose(np.exp(behavior.log_policy(result.action_values[1]))[1:], 0, atol=1e-6)


@pytest.mark.parametrize(("turns", "lengths", "match"), [
    ([[0, 1], [0, 1]], [1.0, 1.0], "turns"),
    ([[0, 2]], [1.0, 1.0], "turns.*0…1"),
    ([[0, 1]], [1.0, 0.0], "lengths"),
    ([[0, 1]], [1.0, np.nan], "lengths"),
])  # fmt: skip
def test_road_network_of_wrong_arguments_raises(turns, lengths, match):
    with pytest.raises(InputError, match=match):
        road_network(np.array(turns), np.array(lengths))


# Slips


def test_slippery_grid_slips_to_either_side_unless_blocked():
    """Along the lower of two rows, under a blocked cell."""
    model = SlipperyGrid(Grid(np.array([[0, 1, 0], [0, 0, 0]])), slip=logit(0.2))
    moves = dense(model)
    np.testing.assert_allclose(moves[4, RIGHT], [0, 0, 0, 0, 0.2, 0.8], atol=1e-12)
    np.testing.assert_allclose(moves[3, RIGHT], [0.1, 0, 0, 0.1, 0.8, 0], atol=1e-12)
    np.testing.assert_allclose(moves[4, UP], [0, 0, 0, 0.1, 0.8, 0.1], atol=1e-12)
    assert float(model.slip[0]) == pytest.approx(0.2)


def test_slippery_grid_without_slips_equals_the_obstacle_grid():
    grid, theta = Grid.unknown(3, 3, connectivity=8), np.random.default_rng(0).normal(size=9)
    terrain = np.full((3, 3), -1)
    terrain[2, 2] = 0
    slippery, plain = dense(SlipperyGrid(grid, theta, 0.0, terrain)), dense(ObstacleGrid(grid, theta))
    np.testing.assert_allclose(slippery[:8], plain[:8], rtol=1e-12)
    assert np.abs(slippery[8] - plain[8]).max() > 0.1


@pytest.mark.parametrize("terrain", [np.zeros((2, 3), int), np.full((2, 2), -1), np.full((2, 2), 1), -np.eye(2) * 2])
def test_slippery_grid_of_a_wrong_terrain_raises(terrain):
    with pytest.raises(InputError, match="terrain"):
        SlipperyGrid(Grid.unknown(2, 2), terrain=terrain.astype(int))


def test_fit_of_a_slippery_grid_with_two_terrains_recovers_walls_and_slips():
    """Slips within four standard deviations of the fraction of moves that slip."""
    rooms, slips = rooms_in_a_row(5, 7, doors=(4,)), np.array([0.1, 0.4])
    terrain = np.zeros((5, 7), int)
    terrain[:, 4:] = 1
    world, random = SlipperyGrid(rooms, slip=logit(slips), terrain=terrain), np.random.default_rng(0)
    goals, free = [0, 16, 6, 27], np.flatnonzero(rooms.known.ravel() == Cell.FREE)
    tasks = [reach(rooms.forget(), goal, discount=1.0, step_cost=1.0) for goal in goals]
    starts = [random.choice(np.setdiff1d(free, [goal]), 10) for goal in goals]
    learned, demos = recovered(world, SlipperyGrid(rooms.forget(), terrain=terrain), tasks, starts, beta=3.0)
    blocked, wall = np.asarray(learned.blocked), rooms.known == Cell.OCCUPIED
    assert blocked[wall].min() > max(0.8, blocked[~wall].max())
    moves = np.bincount(np.asarray(world.terrain)[np.asarray(demos.states)])
    assert (np.abs(learned.slip - slips) < 4 * np.sqrt(slips * (1 - slips) / moves)).all()
