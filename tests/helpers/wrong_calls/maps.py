"""Wrong calls of learned maps and their configuration."""

# ruff: noqa: E501
# pyright: basic, reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false

import numpy as np

import sidestep as ss
from helpers.wrong_calls.small import BEHAVIOR, DEMOS, GRID, INF, MAP, MODEL, NAN, OTHER_GRID, TRUTH, WALKS, labeled
from sidestep.maps.learned_map import PlannedPath

TENTHS = np.full((4, 5), 0.1)
VISITED = np.zeros((0, 2), int)
PATH = PlannedPath(np.array([0]), np.zeros((1, 2)), np.zeros(1), 0.0, 1.0, 0.0, None)
CASES = [
    *labeled("BehaviorConfig", [
        ("another backup", lambda: ss.BehaviorConfig(backup="softmax"), "backup"),
        ("a backup that is no name", lambda: ss.BehaviorConfig(backup=ss.BoltzmannAverage()), "backup"),
        ("the class of a backup", lambda: ss.BehaviorConfig(backup=ss.BoltzmannAverage), "backup"),
        ("beta 0", lambda: ss.BehaviorConfig(beta=0), "beta"),
        ("beta of text", lambda: ss.BehaviorConfig(beta="7"), "beta"),
        ("beta infinite", lambda: ss.BehaviorConfig(beta=INF), "beta"),
        ("lapse 1", lambda: ss.BehaviorConfig(lapse=1.0), "lapse"),
        ("lapse below 0", lambda: ss.BehaviorConfig(lapse=-0.1), "lapse"),
        ("tempering 0", lambda: ss.BehaviorConfig(tempering=0), "tempering"),
        ("horizon of a fraction", lambda: ss.BehaviorConfig(horizon=2.5), "horizon"),
        ("one name without a tuple", lambda: ss.BehaviorConfig(learn="beta"), "learn"),
        ("another parameter", lambda: ss.BehaviorConfig(learn=("gamma",)), "learn"),
    ]),
    *labeled("PriorConfig", [
        ("another kind", lambda: ss.PriorConfig("uniform"), "prior"),
        ("a prior", lambda: ss.PriorConfig(ss.Normal()), "prior"),
        ("a field of the other kind", lambda: ss.PriorConfig("normal", lines=1.0), "lines"),
        ("log-odds NaN", lambda: ss.PriorConfig(log_odds=NAN), "log_odds"),
        ("a weight of text", lambda: ss.PriorConfig(lines="1"), "lines"),
        ("variance 0", lambda: ss.PriorConfig("normal", variance=0.0), "variance"),
        ("mean None", lambda: ss.PriorConfig("normal", mean=None), "mean"),
        ("wall prior below 0", lambda: ss.PriorConfig("normal", wall_prior=-1.0), "wall_prior"),
    ]),
    *labeled("PosteriorConfig and FitConfig", [
        ("another method", lambda: ss.PosteriorConfig("mcmc"), "posterior"),
        ("eleven sweeps", lambda: ss.PosteriorConfig(sweeps=11), "sweeps"),
        ("one chain", lambda: ss.PosteriorConfig(chains=1), "chains"),
        ("chains of text", lambda: ss.PosteriorConfig(chains="2"), "chains"),
        ("other terms", lambda: ss.FitConfig(terms="all"), "terms"),
        ("a tuple of terms", lambda: ss.FitConfig(terms=("actions",)), "terms"),
        ("another gradient", lambda: ss.FitConfig(gradient="numeric"), "gradient"),
        ("no iteration", lambda: ss.FitConfig(max_iterations=0), "max_iterations"),
        ("memory infinite", lambda: ss.FitConfig(memory=INF), "memory"),
        ("memory of text", lambda: ss.FitConfig(memory="2"), "memory"),
        ("large_map below 0", lambda: ss.FitConfig(large_map=-1), "large_map"),
    ]),
    *labeled("MapConfig", [
        ("a discount for a reward", lambda: ss.MapConfig(reward=0.95), "reward"),
        ("a behavior for its configuration", lambda: ss.MapConfig(behavior=BEHAVIOR), "behavior"),
        ("a prior for its configuration", lambda: ss.MapConfig(prior=ss.Normal()), "prior"),
        ("the name of a method", lambda: ss.MapConfig(posterior="sample"), "posterior"),
        ("the class of a part", lambda: ss.MapConfig(fit=ss.FitConfig), "fit"),
        ("a method of the other prior", lambda: ss.MapConfig(posterior=ss.PosteriorConfig("mode")), "posterior"),
        ("no walk", lambda: ss.MapConfig(max_walks=0), "max_walks"),
        ("a seed below 0", lambda: ss.MapConfig(seed=-1), "seed"),
        ("a threshold NaN", lambda: ss.MapConfig(unknown_below=NAN), "unknown_below"),
    ]),
    *labeled("annotations and sensors", [
        ("a column's number", lambda: ss.WalkAnnotations(person_column=3), "person_column"),
        ("positions for candidates", lambda: ss.WalkAnnotations(goal_candidates=np.zeros((2, 2))), "goal_candidates"),
        ("one candidate", lambda: ss.GoalCandidates(np.zeros((1, 2))), "2 candidates"),
        ("candidates of states", lambda: ss.GoalCandidates(np.array([3, 4])), "positions"),
        ("a NaN candidate", lambda: ss.GoalCandidates(np.array([[0.5, 0.5], [NAN, 1.0]])), "positions"),
        ("read_goal_candidates of None", lambda: ss.read_goal_candidates(None), "path"),
        ("a sensor above 1", lambda: ss.SensorMap(TENTHS + 1), "sensor map"),
        ("a sensor of text", lambda: ss.SensorMap("map.yaml"), "sensor map"),
        ("a sensor's variance 0", lambda: ss.SensorMap(TENTHS, 0.0), "variance"),
        ("a sensor's variance of other cells", lambda: ss.SensorMap(TENTHS, np.ones((2, 2))), "variance"),
        ("read_sensor on an array", lambda: ss.read_sensor("map.yaml", TENTHS), "grid"),
    ]),
    *labeled("learn_map", [
        ("demonstrations", lambda: ss.learn_map(GRID, DEMOS), "walks"),
        ("a model", lambda: ss.learn_map(MODEL, WALKS), "grid"),
        ("the path of walks", lambda: ss.learn_map(GRID, "walks.csv"), "walks"),
        ("a behavior", lambda: ss.learn_map(GRID, WALKS, BEHAVIOR), "config"),
        ("an array of a sensor", lambda: ss.learn_map(GRID, WALKS, sensor=TENTHS), "sensor"),
        ("a column for annotations", lambda: ss.learn_map(GRID, WALKS, annotations="person"), "annotations"),
        ("a callback of text", lambda: ss.learn_map(GRID, WALKS, callback="print"), "callback"),
        ("more walks than there are", lambda: ss.learn_map(GRID, WALKS, ss.MapConfig(max_walks=9)), "max_walks"),
    ]),
    *labeled("LearnedMap", [
        ("transposed", lambda: ss.LearnedMap(GRID, TENTHS.T, VISITED, ss.Reward()), "blocked"),
        ("NaN", lambda: ss.LearnedMap(GRID, TENTHS + NAN, VISITED, ss.Reward()), "blocked"),
        ("above 1", lambda: ss.LearnedMap(GRID, TENTHS + 1, VISITED, ss.Reward()), "blocked"),
        ("visited of one axis", lambda: ss.LearnedMap(GRID, TENTHS, np.array([1, 2]), ss.Reward()), "visited"),
        ("visited of another map", lambda: ss.LearnedMap(GRID, TENTHS, [[20, 0]], ss.Reward()), "visited"),
        ("a discount for a reward", lambda: ss.LearnedMap(GRID, TENTHS, VISITED, 0.95), "reward"),
        ("samples of numbers", lambda: ss.LearnedMap(GRID, TENTHS, VISITED, ss.Reward(), samples=TENTHS[None]), "samples"),
        ("information of other cells", lambda: ss.LearnedMap(GRID, TENTHS, VISITED, ss.Reward(), information=np.ones((2, 2))), "information"),
        ("an array for a grid", lambda: ss.LearnedMap(TENTHS, TENTHS, VISITED, ss.Reward()), "grid"),
        ("plan, a risk above 1", lambda: MAP.plan((0.5, 0.5), (1.5, 0.5), max_risk=2), "max_risk"),
        ("plan, a risk of text", lambda: MAP.plan((0.5, 0.5), (1.5, 0.5), max_risk="low"), "max_risk"),
        ("plan, bump cost below 0", lambda: MAP.plan((0.5, 0.5), (1.5, 0.5), bump_cost=-1), "bump_cost"),
        ("plan from outside", lambda: MAP.plan((99.0, 0.5), (1.5, 0.5)), "start"),
        ("evaluate, another truth", lambda: MAP.evaluate(OTHER_GRID), "scored"),
        ("evaluate, an array", lambda: MAP.evaluate(TENTHS), "truth"),
        ("evaluate, a seed", lambda: MAP.evaluate(TRUTH, seed=0.5), "seed"),
        ("save to a number", lambda: MAP.save(3), "folder"),
        ("load_map of None", lambda: ss.load_map(None), "folder"),
        ("load_map of a map", lambda: ss.load_map(MAP), "folder"),
    ]),
    *labeled("PlannedPath", [
        ("within a risk of text", lambda: PATH.within("low"), "max_risk"),
    ]),
]  # fmt: skip
