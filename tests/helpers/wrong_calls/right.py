"""Calls with lists, integers, NumPy's numbers and paths, which must work."""

# pyright: basic, reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa

import sidestep as ss
from helpers.wrong_calls.small import (
    BEHAVIOR,
    DEMOS,
    GRID,
    KEY,
    LAPLACE,
    MAP,
    MODEL,
    MRF_FIT,
    NAN,
    PRIOR,
    TABLE,
    TASK,
    TRUTH,
    WALKS,
    walk,
)
from sidestep.evaluation.metrics import score_paths, visit_ranking
from sidestep.evaluation.ranks import rank
from sidestep.io.walks import walks_from_table
from sidestep.worlds.offices import office
from sidestep.worlds.rooms import rooms_in_a_row

NORMAL = ss.Normal(0.0, 1.0)
CASES = {
    "Grid of a list": lambda: ss.Grid([[0, 1]], resolution=1, origin=[0, 0, 0]).known.dtype == np.int8,
    "Grid of booleans' states": lambda: ss.Grid([[ss.Cell.FREE, ss.Cell.UNKNOWN]]).known.tolist() == [[0, -1]],
    "Grid of bytes": lambda: ss.Grid(np.zeros((1, 2), np.uint8)).size == 2,
    "Grid with NumPy's numbers": lambda: ss.Grid(np.zeros((1, 2), int), np.float32(0.5), np.zeros(3)).size == 2,
    "Grid.unknown of NumPy's numbers": lambda: ss.Grid.unknown(np.int64(2), np.int8(3)).shape == (2, 3),
    "Grid.state of integers": lambda: ss.Grid.unknown(1, 3).state((1, 0)) == 1,
    "Grid.state of an array": lambda: ss.Grid.unknown(1, 3).state(np.array([0.5, 0.5])) == 0,
    "Grid.states of a list": lambda: GRID.states([[0.5, 0.5], [1, 0]]).tolist() == [15, 16],
    "Grid.contains of NaN": lambda: GRID.contains([(NAN, 0.5), (0.5, 0.5)]).tolist() == [False, True],
    "Grid.centers of a list": lambda: GRID.centers([15]).tolist() == [[0.5, 0.5]],
    "Grid.centers of nothing": lambda: GRID.centers([]).shape == (0, 2),
    "Grid.centers of bytes": lambda: (
        ss.Grid.unknown(1, 300).centers(np.array([200], np.uint8)).tolist() == [[200.5, 0.5]]
    ),
    "Grid.centers of JAX's integers": lambda: GRID.centers(jnp.array([15])).tolist() == [[0.5, 0.5]],
    "gather of lists": lambda: ss.gather([walk([0, 1], [3])], (TASK,)).states.tolist() == [0],
    "gather of tuples": lambda: len(ss.gather((walk((0, 1), (3,), np.int64(0)),), [TASK])) == 1,
    "gather of a generator": lambda: len(ss.gather((each for each in [walk([0, 1], [3])]), [TASK])) == 1,
    "with_only of a list": lambda: DEMOS.with_only([True, False]).weights.sum() == 3,
    "split_by_person of a list": lambda: ss.split_by_person(DEMOS, [0, 1])[1].tolist() == [0, 1],
    "Reward of integers": lambda: ss.Reward(1, 1).step_cost == 1,
    "Reward of NumPy's numbers": lambda: ss.Reward(np.float32(0.5)).discount == 0.5,
    "select of a list": lambda: WALKS.select([1]).labels == [1],
    "select of a list of booleans": lambda: WALKS.select([True, False]).labels == [0],
    "select from the end": lambda: WALKS.select(np.array([-1])).labels == [1],
    "select of nothing": lambda: len(WALKS.select([])) == 0,
    "walks_from_table of a batch": lambda: len(walks_from_table(pa.record_batch(TABLE.to_pydict()))) == 2,
    "demonstrations_from_walks of integers": lambda: (
        len(ss.demonstrations_from_walks(WALKS, GRID, discount=1, step_cost=1)) == 3
    ),
    "ObstacleGrid of an integer": lambda: ss.ObstacleGrid(GRID, -2).parameters.shape == (20,),
    "ObstacleGrid of a list": lambda: ss.ObstacleGrid(ss.Grid.unknown(1, 2), [0, 1]).parameters.tolist() == [0.0, 1.0],
    "ObstacleGrid of NumPy's number": lambda: ss.ObstacleGrid(GRID, np.float32(-2)).parameters.shape == (20,),
    "ObstacleGrid of infinite logits": lambda: ss.ObstacleGrid(GRID, -np.inf).parameters.max() == -np.inf,
    "ObstacleGrid under eval_shape": lambda: (
        jax.eval_shape(lambda logits: ss.ObstacleGrid(GRID, logits).parameters, jnp.zeros(20)).shape == (20,)
    ),
    "SlipperyGrid of lists": lambda: ss.SlipperyGrid(ss.Grid.unknown(1, 2), [0, 0], 0, [[0, 1]]).parameters.size == 4,
    "walled_grid of a list": lambda: ss.walled_grid(ss.Grid.unknown(1, 3), [0, 1]).parameters.tolist() == [0.0, 1.0],
    "FeaturedGrid of a list": lambda: (
        ss.FeaturedGrid(
            ss.Grid.unknown(1, 2), [[1.0], [2.0]], jax.tree_util.Partial(lambda w, x: w @ x, jnp.ones(1))
        ).features.shape
        == (2, 1)
    ),
    "Normal of integers": lambda: ss.Normal(-2, 2).variance == 2,
    "Normal of lists": lambda: ss.Normal([0, 1], [1, 2]).mean.tolist() == [0, 1],
    "GaussianMRF of lists": lambda: ss.GaussianMRF(NORMAL, [[0, 1]], 1).pairs.tolist() == [[0, 1]],
    "WallPrior of a list": lambda: ss.WallPrior(NORMAL, [[1, -1, 1]], 1).known.shape == (1, 3),
    "FreeCellEvidence of a list": lambda: ss.FreeCellEvidence(NORMAL, [1, 0]).counts.tolist() == [1, 0],
    "sensor_prior of lists": lambda: ss.sensor_prior([[0.5, NAN]], 1, NORMAL).mean.tolist() == [0, 0],
    "BinaryMRF of a list": lambda: ss.BinaryMRF([0, 1], [1, 2], lines=1).shape == (1, 2),
    "BinaryMRF of NumPy's shape": lambda: ss.BinaryMRF(np.zeros(2), np.array([1, 2])).shape == (1, 2),
    "BinaryMRF, log_density of a list": lambda: PRIOR.log_density([0] * 20) == 0,
    "hierarchical_mrf of a list": lambda: ss.hierarchical_mrf([NAN, 0]).varied.tolist() == [True, False],
    "MeanField of a list": lambda: ss.MeanField(ss.BinaryMRF([0, 0]), [-1, 0]).known.shape == (2,),
    "MRFFit.prior of a list": lambda: MRF_FIT.prior([1, 2], 0).field.tolist() == [0, 0],
    "fit_mrf of a tuple": lambda: ss.fit_mrf((ss.Grid([[0, 1]]),), []).lines == 0,
    "LBFGS of NumPy's numbers": lambda: ss.LBFGS(np.int64(3), np.float32(1)).max_iterations == 3,
    "LBFGS without iterations": lambda: ss.LBFGS(max_iterations=0, tolerance=0).tolerance == 0,
    "Adam of integers": lambda: ss.Adam(learning_rate=1).learning_rate == 1,
    "split_rhat of lists": lambda: ss.split_rhat([[[1], [2], [1], [2]]] * 2).shape == (1,),
    "split_rhat of booleans": lambda: ss.split_rhat(np.ones((2, 4, 1), bool)).tolist() == [1],
    "tasks_mesh of a tuple": lambda: ss.tasks_mesh(tuple(jax.devices()[:1])).size == 1,
    "Laplace.sample of an old key": lambda: LAPLACE.sample(jax.random.PRNGKey(0), np.int64(2)).model.shape == (2, 2),
    "Laplace.sample of a key": lambda: LAPLACE.sample(KEY, 2).model.shape == (2, 2),
    "risk_averse_robot of a list": lambda: ss.risk_averse_robot(MODEL, [0, 1], 40).goal_mask().size == 20,
    "MapConfig of integers": lambda: ss.MapConfig(behavior=ss.BehaviorConfig(beta=5, learn=["lapse"])).agents.beta == 5,
    "PriorConfig of integers": lambda: ss.PriorConfig("normal", mean=0, variance=1).mean == 0,
    "GoalCandidates of a list": lambda: ss.GoalCandidates([[0, 0], [1, 1]]).positions.shape == (2, 2),
    "LearnedMap of lists": lambda: (
        ss.LearnedMap(ss.Grid([[0, -1]]), [[0, 1]], [[0, 1]], ss.Reward()).visited.shape == (1, 2)
    ),
    "LearnedMap of certain cells": lambda: (
        ss.LearnedMap(ss.Grid([[-1, -1]]), [[0.0, 1.0]], np.zeros((0, 2), int), ss.Reward()).model.parameters.shape
        == (2,)
    ),
    "Checkpoint of a text": lambda: ss.Checkpoint("a").max_fraction == 0.1,
    "score_paths of lists": lambda: score_paths([[0, 1]], [1], TRUTH).legal_fraction == 1,
    "visit_ranking of a list": lambda: visit_ranking([0, 0], GRID)[0, 0] == -2,
    "rank of a list": lambda: rank(2, [1, 3], np.random.default_rng(0)) == 1,
    "office of NumPy's numbers": lambda: office(np.int64(12), np.int64(12), seed=np.int64(0)).shape == (12, 12),
    "rooms_in_a_row of a list": lambda: rooms_in_a_row(3, 5, doors=[2]).size == 15,
    "evaluate of lists": lambda: (
        ss.evaluate(None, np.zeros((1, 2)).tolist(), ss.Grid([[0, 0]]), [[True, True]], [[0, 1]], goals=[1]).auc is None
    ),
    "Behavior of a class": lambda: isinstance(ss.Behavior(ss.BoltzmannAverage).backup, ss.BoltzmannAverage),
    "Behavior of a name": lambda: isinstance(ss.Behavior("boltzmann").backup, ss.BoltzmannAverage),
    "Behavior of integers": lambda: ss.Behavior(ss.BoltzmannAverage(), 5, 0).beta == 5,
    "graph of a list": lambda: ss.graph([[[0]]]).states == 1,
    "task of lists": lambda: ss.task([0, 1], 1, [False, True]).terminal.tolist() == [False, True],
    "reach of NumPy's numbers": lambda: ss.reach(GRID, np.int8(3), discount=1, step_cost=np.int64(1)).discount == 1,
    "behavior_model of a list": lambda: len(ss.behavior_model(BEHAVIOR, person=[0, 1]).person) == 2,
    "Behavior": lambda: BEHAVIOR.lapse is None and MAP.converged is None,
}
