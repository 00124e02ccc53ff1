"""Wrong calls of transition models, robots, evaluation and worlds."""

# ruff: noqa: E501
# pyright: basic, reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false

import jax.numpy as jnp
import numpy as np

import sidestep as ss
from helpers.wrong_calls.small import BEHAVIOR, DEMOS, GRID, KEY, MAP, MODEL, NAN, TRUTH, WALKS, labeled
from sidestep.baselines import BASELINES
from sidestep.baselines.comparison import compare_methods
from sidestep.evaluation.metrics import score_map, score_paths, visit_ranking
from sidestep.evaluation.ranks import rank, uniform_band
from sidestep.evaluation.relevance import relevant_obstacles
from sidestep.evaluation.reliability import brier_score
from sidestep.evaluation.study import run_method
from sidestep.maps.config import SimulationConfig
from sidestep.worlds.apartments import apartment
from sidestep.worlds.blocks import blocks
from sidestep.worlds.continuous_room import room
from sidestep.worlds.offices import office, places
from sidestep.worlds.rooms import rooms_in_a_row
from sidestep.worlds.walks import simulate_walks

ROBOT = ss.risk_averse_robot(MODEL, [])
SCORED = np.ones((4, 5), bool)
VISITED = np.zeros((0, 2), int)
ZEROS = np.zeros((4, 5))
CASES = [
    *labeled("ObstacleGrid", [
        ("NaN logits", lambda: ss.ObstacleGrid(GRID, np.full(20, NAN)), "logits"),
        ("logits of text", lambda: ss.ObstacleGrid(GRID, "x"), "logits"),
        ("too few logits", lambda: ss.ObstacleGrid(GRID, np.zeros(3)), "(20,)"),
        ("logits with two axes", lambda: ss.ObstacleGrid(GRID, np.zeros((4, 5))), "logits"),
        ("logits None", lambda: ss.ObstacleGrid(GRID, None), "logits"),
        ("a NaN logit of JAX", lambda: ss.ObstacleGrid(GRID, jnp.asarray([NAN] * 20)), "logits"),
        ("complex logits", lambda: ss.ObstacleGrid(GRID, 1j), "logits"),
        ("an array for a grid", lambda: ss.ObstacleGrid(np.zeros((4, 5), int)), "grid"),
        ("the class Grid", lambda: ss.ObstacleGrid(ss.Grid), "the class Grid"),
    ]),
    *labeled("FeaturedGrid", [
        ("features of other cells", lambda: ss.FeaturedGrid(GRID, np.zeros((3, 2)), lambda x: x[0]), "features"),
        ("NaN features", lambda: ss.FeaturedGrid(GRID, np.full((20, 2), NAN), lambda x: x[0]), "features"),
        ("features of one axis", lambda: ss.FeaturedGrid(GRID, np.zeros(20), lambda x: x[0]), "features"),
        ("a network of text", lambda: ss.FeaturedGrid(GRID, np.zeros((20, 2)), "linear"), "network"),
        ("another grid", lambda: ss.FeaturedGrid("grid", np.zeros((20, 2)), lambda x: x[0]), "grid"),
    ]),
    *labeled("SlipperyGrid", [
        ("terrain of another shape", lambda: ss.SlipperyGrid(GRID, terrain=np.zeros((2, 2), int)), "terrain"),
        ("terrain of floats", lambda: ss.SlipperyGrid(GRID, terrain=ZEROS), "terrain"),
        ("terrain below -1", lambda: ss.SlipperyGrid(GRID, terrain=np.full((4, 5), -2)), "terrain"),
        ("terrain with a gap", lambda: ss.SlipperyGrid(GRID, terrain=np.ones((4, 5), int)), "terrain"),
        ("slips of other terrains", lambda: ss.SlipperyGrid(GRID, slip=np.zeros(2)), "slip"),
        ("slip NaN", lambda: ss.SlipperyGrid(GRID, slip=NAN), "slip"),
        ("slip of text", lambda: ss.SlipperyGrid(GRID, slip="much"), "slip"),
        ("logits None", lambda: ss.SlipperyGrid(GRID, logits=None), "logits"),
        ("another grid", lambda: ss.SlipperyGrid(MODEL), "grid"),
    ]),
    *labeled("walls", [
        ("walled_grid, other borders", lambda: ss.walled_grid(GRID, np.zeros(3)), "(31,)"),
        ("walled_grid, NaN", lambda: ss.walled_grid(GRID, NAN), "logits"),
        ("walled_grid of diagonals", lambda: ss.walled_grid(ss.Grid.unknown(2, 2, 8)), "connectivity"),
        ("walled_grid of a shape", lambda: ss.walled_grid((4, 5)), "grid"),
        ("borders of an array", lambda: ss.borders(ZEROS), "grid"),
        ("true_model of a model", lambda: ss.true_model(MODEL), "grid"),
        ("barriers_of a grid", lambda: ss.barriers_of(GRID), "model"),
        ("barriers_of a class", lambda: ss.barriers_of(ss.ObstacleGrid), "model"),
        ("barriers_of None", lambda: ss.barriers_of(None), "model"),
    ]),
    *labeled("risk_averse_robot", [
        ("of a grid", lambda: ss.risk_averse_robot(GRID, []), "model"),
        ("states that are not there", lambda: ss.risk_averse_robot(MODEL, [20]), "visited"),
        ("a state below 0", lambda: ss.risk_averse_robot(MODEL, [-1]), "visited"),
        ("fractions", lambda: ss.risk_averse_robot(MODEL, [0.5]), "visited"),
        ("a mask", lambda: ss.risk_averse_robot(MODEL, np.ones(20, bool)), "visited"),
        ("bump cost below 0", lambda: ss.risk_averse_robot(MODEL, [], bump_cost=-1.0), "bump_cost"),
        ("bump cost of text", lambda: ss.risk_averse_robot(MODEL, [], bump_cost="40"), "bump_cost"),
        ("bump cost NaN", lambda: MAP.robot(NAN), "bump_cost"),
    ]),
    *labeled("evaluate", [
        ("a truth of another shape", lambda: ss.evaluate(ROBOT, ZEROS, ss.Grid.unknown(2, 2), SCORED, VISITED), "scored"),
        ("a truth of an array", lambda: ss.evaluate(ROBOT, ZEROS, ZEROS, SCORED, VISITED), "truth"),
        ("a model for a planner", lambda: ss.evaluate(MODEL, ZEROS, TRUTH, SCORED, VISITED), "planner"),
        ("a ranking with NaN", lambda: ss.evaluate(ROBOT, ZEROS + NAN, TRUTH, SCORED, VISITED), "ranking"),
        ("numbers for a mask", lambda: ss.evaluate(ROBOT, ZEROS, TRUTH, ZEROS, VISITED), "scored"),
        ("visited of one axis", lambda: ss.evaluate(ROBOT, ZEROS, TRUTH, SCORED, np.zeros(3, int)), "visited"),
        ("visited outside", lambda: ss.evaluate(ROBOT, ZEROS, TRUTH, SCORED, [[0, 99]]), "visited"),
        ("goals outside", lambda: ss.evaluate(ROBOT, ZEROS, TRUTH, SCORED, VISITED, goals=[20]), "goals"),
        ("a seed of text", lambda: ss.evaluate(ROBOT, ZEROS, TRUTH, SCORED, VISITED, seed="0"), "seed"),
        ("a callback of text", lambda: ss.evaluate(ROBOT, ZEROS, TRUTH, SCORED, VISITED, callback="print"), "callback"),
        ("plan_paths of a model", lambda: ss.plan_paths(MODEL, [0], [1]), "planner"),
        ("plan_paths, starts outside", lambda: ss.plan_paths(ROBOT, [99], [1]), "starts"),
        ("plan_paths, goals of fractions", lambda: ss.plan_paths(ROBOT, [0], [0.5]), "goals"),
        ("score_map, another shape", lambda: score_map(np.zeros((2, 2)), TRUTH, SCORED, SCORED), "blocked"),
        ("score_map, a mask of numbers", lambda: score_map(ZEROS, TRUTH, SCORED, ZEROS), "relevant"),
        ("score_paths, too few goals", lambda: score_paths([np.array([0, 1])], [], TRUTH), "goals"),
        ("score_paths, a number", lambda: score_paths(3, [1], TRUTH), "paths"),
        ("visit_ranking, fractions", lambda: visit_ranking(np.array([0.5]), GRID), "visited"),
        ("relevant_obstacles, goals", lambda: relevant_obstacles(TRUTH, np.array([0]), np.array([0, 1])), "goals"),
        ("rank among text", lambda: rank(0.5, "draws", np.random.default_rng(0)), "draws"),
        ("rank with a seed", lambda: rank(0.5, np.zeros(3), 0), "random"),
        ("uniform_band of no draws", lambda: uniform_band(10, 0), "draws"),
        ("uniform_band, probability", lambda: uniform_band(10, 10, probability="0.9"), "probability"),
        ("brier_score above 1", lambda: brier_score(np.array([2.0]), np.array([True])), "blocked"),
        ("brier_score, too few flags", lambda: brier_score(np.array([0.5]), np.array([], bool)), "obstacle"),
    ]),
    *labeled("worlds", [
        ("room of one point", lambda: room(1), "lattice_points"),
        ("run_method of a grid", lambda: run_method(GRID, "method", lambda *_: None), "problem"),
        ("office of text", lambda: office("20", 30, seed=0), "rows"),
        ("office of fractions", lambda: office(20, 30.5, seed=0), "columns"),
        ("office, a seed below 0", lambda: office(20, 30, seed=-1), "seed"),
        ("office, connectivity", lambda: office(20, 30, seed=0, connectivity=3), "connectivity"),
        ("places, none", lambda: places(TRUTH, 0, seed=0), "count"),
        ("places, a key", lambda: places(TRUTH, 1, seed=KEY), "seed"),
        ("apartment, rows", lambda: apartment(4, 30, seed=0), "rows"),
        ("blocks, density", lambda: blocks(5, 5, seed=0, density="few"), "density"),
        ("blocks, sizes", lambda: blocks(5, 5, seed=0, sizes=(5, 2)), "sizes"),
        ("rooms, a door of a fraction", lambda: rooms_in_a_row(3, 5, doors=(0.5,)), "doors"),
        ("rooms, a door outside", lambda: rooms_in_a_row(3, 5, doors=(3,)), "doors"),
        ("simulate_walks, a configuration of maps", lambda: simulate_walks(TRUTH, ss.MapConfig()), "config"),
        ("simulate_walks, an array", lambda: simulate_walks(ZEROS, SimulationConfig()), "grid"),
    ]),
    *labeled("baselines", [
        (f"{name}, demonstrations of another map", lambda method=method: method(ss.Grid.unknown(2, 2), DEMOS, ss.MapConfig()), "demonstrations")
        for name, method in BASELINES.items()
    ]),
    *labeled("baselines", [
        ("cloning, walks", lambda: BASELINES["cloning"](GRID, WALKS, ss.MapConfig()), "demonstrations"),
        ("visits, a behavior", lambda: BASELINES["visits"](GRID, DEMOS, BEHAVIOR), "config"),
        ("compare_methods, demonstrations", lambda: compare_methods(GRID, TRUTH, DEMOS, ss.MapConfig()), "walks"),
        ("compare_methods, another truth", lambda: compare_methods(GRID, ss.Grid.unknown(2, 2), WALKS, ss.MapConfig()), "truth"),
        ("compare_methods, all held out", lambda: compare_methods(GRID, TRUTH, WALKS, ss.MapConfig(), hold_out=1), "hold_out"),
        ("compare_methods, NaN held out", lambda: compare_methods(GRID, TRUTH, WALKS, ss.MapConfig(), hold_out=NAN), "hold_out"),
    ]),
]  # fmt: skip
