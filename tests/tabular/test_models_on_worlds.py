"""Worlds that are not obstacle grids: what their rules say, and that the rules are found from what people do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.inference.fit import fit
from sidestep.inference.priors import Normal
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.demonstrations import gather
from sidestep.tabular.graph import Graph
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid, SlipperyGrid, closed, road_network, true_model, walled_grid
from sidestep.tabular.planning import plan
from sidestep.tabular.simulation import simulate
from sidestep.tabular.solve import solve
from sidestep.tabular.tasks import Task, reach
from sidestep.worlds.farm import Farm
from sidestep.worlds.gravity import DIRECTIONS, Gravity, most_probable_rule
from sidestep.worlds.rooms import three_rooms, two_rooms

UP, DOWN, LEFT, RIGHT = range(4)


def surely(model, state, action):
    """Where an action leads, if it surely leads somewhere."""
    chances = np.asarray(model.probabilities()[state, action])
    assert chances.max() > 1 - 1e-4
    return int(model.graph.successors[state, action, chances.argmax()])


def logit(chance):
    return np.log(chance) - np.log1p(-np.asarray(chance))


def dense(model):
    """T[s, a, s′]."""
    states = np.eye(model.graph.states)[np.asarray(model.graph.successors)]
    return np.einsum("sak,sakt->sat", model.probabilities(), states)


def anywhere(graph: Graph, states, discount=0.95) -> Task:
    """The task of reaching any of some states."""
    terminal = jnp.zeros(graph.states, bool).at[jnp.asarray(states)].set(True)
    return Task(jnp.zeros((1, 1)), jnp.ones(1), terminal, jnp.asarray(discount))


# Gravity

COLOURS = np.zeros((5, 5), int)
COLOURS[1, 1], COLOURS[1, 3], COLOURS[3, 1], COLOURS[3, 3], COLOURS[0, 2], COLOURS[4, 2] = 1, 2, 3, 4, 1, 3
RULE = np.array([UP, DOWN, LEFT, RIGHT])
FALLING = Gravity(COLOURS)


def test_nobody_moves_against_gravity_and_colours_turn_it():
    model = FALLING.known_model(RULE)
    middle = 4 * 12
    for gravity, against in zip(range(4), (DOWN, UP, RIGHT, LEFT), strict=True):
        for action, target in zip(range(4), (7, 17, 11, 13), strict=True):
            expected = middle + gravity if action == against else 4 * target + gravity
            assert surely(model, middle + gravity, action) == expected, (DIRECTIONS[gravity], action)
    assert surely(model, 4 * 5 + DOWN, RIGHT) == 4 * 6 + UP
    assert surely(model, 4 * 8 + UP, LEFT) == 4 * 7 + UP  # away from a colour nothing turns
    assert surely(model, 4 * 2 + DOWN, UP) == 4 * 2 + DOWN  # nor at the border of the map
    # every colour is the same everywhere
    assert surely(model, 4 * 3 + LEFT, LEFT) == 4 * 2 + UP


def test_before_anything_is_known_every_direction_is_as_probable():
    chances = FALLING.model().probabilities()[4 * 5 + DOWN, RIGHT]
    np.testing.assert_allclose(chances, 0.25)
    with pytest.raises(InputError, match="colors"):
        Gravity(np.zeros((2, 2), int)).model()


def test_the_most_probable_rule_gravity_is_found_from_ten_demonstrations_a_goal():
    """Of optimal people, who choose their colours by where these let them go."""
    world, random = FALLING.known_model(RULE), np.random.default_rng(1)
    goals = [0, 4, 20, 24]
    tasks = [anywhere(world.graph, 4 * goal + np.arange(4)) for goal in goals]
    # in some corners one falls for ever
    arriving = [np.flatnonzero(np.asarray(plan(world, task).solution.values) > 1e-3) for task in tasks]
    starts = [
        random.choice(np.setdiff1d(own, 4 * goal + np.arange(4)), 10) for own, goal in zip(arriving, goals, strict=True)
    ]
    demos = gather(simulate(jax.random.key(0), world, tasks, starts), tasks)
    found = fit(FALLING.model(), demos, Behavior(BoltzmannAverage(), 10.0), prior=Normal(0.0, 2.0))
    assert found.converged
    assert most_probable_rule(found.model).tolist() == RULE.tolist()


# The farm

TERRAIN = np.array([[0, 0, 1, 0, 0], [0, 0, 1, 0, 0], [0, 0, 1, 2, 2], [0, 0, 2, 0, 0], [0, 0, 2, 0, 0]])
MACHINE = np.full((5, 5), -1)
MACHINE[0, 0], MACHINE[4, 0], MACHINE[2, 0] = 0, 1, 2
ENTERS = np.array([[True, False, False], [False, True, False]])
FARM = Farm(TERRAIN, MACHINE)


def test_terrain_stops_the_wrong_machine_and_machines_are_swapped():
    model = FARM.known_model(ENTERS)
    beside_first, beside_second = 3 * 1, 3 * 16
    assert surely(model, beside_first + 0, RIGHT) == 3 * 2 + 0
    assert surely(model, beside_first + 1, RIGHT) == beside_first + 1
    assert surely(model, beside_second + 0, RIGHT) == beside_second + 0
    assert surely(model, beside_second + 1, RIGHT) == 3 * 17 + 1
    assert surely(model, beside_first + 2, LEFT) == 3 * 0 + 0  # the first machine stands there
    assert surely(model, 3 * 0 + 2, UP) == 3 * 0 + 2  # but nobody gets there by staying there
    np.testing.assert_allclose(FARM.model().probabilities()[beside_first, RIGHT], 0.5)
    with pytest.raises(InputError, match="terrain"):
        Farm(np.zeros((2, 2), int), MACHINE).model()


@pytest.mark.parametrize("terms", [("actions",), ("actions", "transitions")])
def test_what_machines_can_enter_is_found_from_ten_demonstrations_a_goal(terms):
    """Optimal people never try in vain; that they fetch another machine says what theirs cannot do."""
    world, random = FARM.known_model(ENTERS), np.random.default_rng(2)
    goals = [4, 14, 24, 5]
    tasks = [anywhere(world.graph, 3 * goal + np.arange(3)) for goal in goals]
    ground = np.setdiff1d(np.flatnonzero((TERRAIN == 0) & (MACHINE < 0)), goals)
    starts = [3 * random.choice(ground[ground % 5 < 2], 10) + random.integers(3, size=10) for _ in goals]
    demos = gather(simulate(jax.random.key(0), world, tasks, starts), tasks)
    bumped = demos.states == demos.next_states
    assert not bumped.any()
    found = fit(FARM.model(), demos, Behavior(BoltzmannAverage(), 10.0), prior=Normal(0.0, 2.0), terms=terms)
    assert found.converged
    assert ((np.asarray(FARM.stop_probabilities(found.model)) < 0.5) == ENTERS).all()


# Walls between cells, and roads


def test_a_wall_between_cells_is_found_where_nobody_could_pass():
    """A room of five by six; the wall runs between its third and fourth column but for the last row."""
    grid = ObstacleGrid(Grid.unknown(5, 6))
    shut = np.full(walled_grid(Grid.unknown(5, 6)).parameters.shape, -12.0)
    wall = [5 * row + 2 for row in range(4)]
    shut[wall] = 12.0
    world, random = walled_grid(Grid.unknown(5, 6), shut), np.random.default_rng(3)
    goals = [0, 5, 12, 17]
    tasks = [reach(grid.graph, goal) for goal in goals]
    starts = [random.choice(np.setdiff1d(np.arange(30), [goal]), 15) for goal in goals]
    demos = gather(simulate(jax.random.key(0), world, tasks, starts), tasks)
    assert not (demos.states == demos.next_states).any()
    found = fit(walled_grid(Grid.unknown(5, 6)), demos, Behavior(BoltzmannAverage(), 10.0), prior=Normal(-2.0, 4.0))
    chances = np.asarray(closed(found.model))
    others = np.delete(chances, wall)
    assert found.converged
    assert chances[wall].min() > 0.5
    assert (others < 0.5).mean() > 0.95


def test_walls_stand_between_cells_that_are_free():
    known = np.zeros((2, 3), int)
    known[0, 2] = 1
    model = walled_grid(Grid(known), -12.0)
    assert surely(model, 1, RIGHT) == 1  # blocked, whatever the wall before it
    assert surely(model, 0, RIGHT) == 1
    np.testing.assert_allclose(dense(model)[:2], dense(true_model(Grid(known)))[:2], atol=1e-5)
    with pytest.raises(InputError, match="connectivity"):
        walled_grid(Grid(known, connectivity=8))


def test_a_closed_link_is_found_from_trips_around_it():
    """A ring of eight links both ways; link 3 is closed, and trips that would use it go round the other way."""
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
    demos = gather(simulate(jax.random.key(0), world, tasks, starts), tasks)
    found = fit(road_network(turns, np.ones(16)), demos, Behavior(BoltzmannAverage(), 10.0), prior=Normal(-2.0, 4.0))
    chances = np.asarray(closed(found.model))
    assert found.converged
    assert chances.argmax() == 3
    assert chances[3] > 0.5


def test_who_pays_by_length_does_not_try_turns_that_are_not_there():
    """Link 0 leads onto three links, link 1 onto the goal alone: its other two actions are no turns."""
    model = road_network(np.array([[0, 1], [0, 2], [0, 3], [1, 3], [2, 0]]), np.array([3.0, 1.0, 5.0, 0.5]), -20.0)
    behavior = Behavior(BoltzmannAverage(), 2.0)
    found = solve(model, reach(model.graph, 3, discount=1.0, step_cost=1.0), behavior)
    assert found.converged
    np.testing.assert_allclose(found.values[1], -0.5, atol=1e-6)
    np.testing.assert_allclose(np.exp(behavior.log_policy(found.action_values[1]))[1:], 0, atol=1e-6)


@pytest.mark.parametrize(
    ("turns", "lengths", "match"),
    [
        ([[0, 1], [0, 1]], [1.0, 1.0], "turns"),
        ([[0, 2]], [1.0, 1.0], "turns.*0…1"),
        ([[0, 1]], [1.0, 0.0], "lengths"),
        ([[0, 1]], [1.0, np.nan], "lengths"),
    ],
)
def test_roads_that_are_none_are_refused(turns, lengths, match):
    with pytest.raises(InputError, match=match):
        road_network(np.array(turns), np.array(lengths))


# Slips


def test_a_slip_leads_to_either_side_and_fails_where_something_is_in_the_way():
    """Along the lower of two rows, under a blocked cell."""
    model = SlipperyGrid(Grid(np.array([[0, 1, 0], [0, 0, 0]])), slip=logit(0.2))
    moves = dense(model)
    np.testing.assert_allclose(moves[4, RIGHT], [0, 0, 0, 0, 0.2, 0.8], atol=1e-12)
    np.testing.assert_allclose(moves[3, RIGHT], [0.1, 0, 0, 0.1, 0.8, 0], atol=1e-12)
    np.testing.assert_allclose(moves[4, UP], [0, 0, 0, 0.1, 0.8, 0.1], atol=1e-12)
    assert float(model.slip[0]) == pytest.approx(0.2)


def test_where_nobody_slips_a_grid_is_an_obstacle_grid():
    grid, theta = Grid.unknown(3, 3, connectivity=8), np.random.default_rng(0).normal(size=9)
    terrain = np.full((3, 3), -1)
    terrain[2, 2] = 0
    slippery, plain = dense(SlipperyGrid(grid, theta, 0.0, terrain)), dense(ObstacleGrid(grid, theta))
    np.testing.assert_allclose(slippery[:8], plain[:8], rtol=1e-12)
    assert np.abs(slippery[8] - plain[8]).max() > 0.1


@pytest.mark.parametrize("terrain", [np.zeros((2, 3), int), np.full((2, 2), -1), np.full((2, 2), 1), -np.eye(2) * 2])
def test_terrain_that_is_none_is_refused(terrain):
    with pytest.raises(InputError, match="terrain"):
        SlipperyGrid(Grid.unknown(2, 2), terrain=terrain.astype(int))


def learned_with_slips(flat, slips, terrain, goals):
    """Walls and slips, from optimal walks of people who know both; and how often people moved on each terrain."""
    world, random = SlipperyGrid(flat, slip=logit(slips), terrain=terrain), np.random.default_rng(0)
    free = np.flatnonzero(flat.known.ravel() == Cell.FREE)
    tasks = [reach(flat.forget(), goal, discount=1.0, step_cost=1.0) for goal in goals]
    starts = [random.choice(np.setdiff1d(free, [goal]), 10) for goal in goals]
    demos = gather(simulate(jax.random.key(0), world, tasks, starts), tasks)
    behavior = Behavior(BoltzmannAverage(), 3.0)
    found = fit(SlipperyGrid(flat.forget(), terrain=terrain), demos, behavior, prior=Normal(-2.0, 4.0))
    assert found.converged
    blocked, wall = np.asarray(found.model.blocked), flat.known == Cell.OCCUPIED
    assert blocked[wall].min() > 0.8
    assert blocked[wall].min() > blocked[~wall].max()
    return np.asarray(found.model.slip), np.bincount(np.asarray(world.terrain)[np.asarray(demos.states)])


def check_slips(found, slips, moves):
    """Within four standard deviations of the share that moves on each terrain really slip."""
    slips = np.asarray(slips)
    assert (np.abs(found - slips) < 4 * np.sqrt(slips * (1 - slips) / moves)).all()


def test_walls_and_slips_of_two_terrains_are_found_together():
    terrain = np.zeros((7, 9), int)
    terrain[:, 5:] = 1
    slips, goals = [0.1, 0.4], [0, 21, 46, 8, 26, 62, 5]
    found, moves = learned_with_slips(two_rooms(7, 9, door=6), slips, terrain, goals)
    check_slips(found, slips, moves)


def test_a_slip_that_all_cells_share_is_found_in_three_rooms():
    goals = [0, 24, 4, 28, 10, 52, 31]
    found, moves = learned_with_slips(three_rooms(5, 11, doors=(4, 0)), [0.2], None, goals)
    check_slips(found, [0.2], moves)
