"""Comparison of behavior-aware modeling with its baselines on the same walks, by the same scores."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from sidestep.baselines import BASELINES
from sidestep.baselines.interface import Method, ModelResult, model_result
from sidestep.errors import ImproperTask, NotConverged, check, check_instance, to_number
from sidestep.evaluation.study import Problem, Record, run_method
from sidestep.inference.goals import goal_posterior
from sidestep.io.gridding import Moves, grid_walks
from sidestep.io.walks import Walks
from sidestep.maps.annotations import NO_ANNOTATIONS, WalkAnnotations, persons_of
from sidestep.maps.config import MapConfig
from sidestep.maps.fit import behavior_of, demonstrations_of
from sidestep.maps.learn import Learning, learn_map, sample_walks, with_annotations
from sidestep.maps.learned_map import LearnedMap
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Grid


@dataclass(frozen=True, eq=False)
class Comparison:
    """The scores of all methods on the same walks.

    Attributes:
        problem: The map, the true map, what was learned from and what was held out.
        config: The configuration; with persons, β is learned.
        records: The scores of each method, behavior-aware modeling first.
        learned: The map of behavior-aware modeling; None if it failed.
    """

    problem: Problem
    config: MapConfig
    records: list[Record]
    learned: LearnedMap | None

    def method_scores(self) -> dict[str, dict[str, Any]]:
        """Return the scores of each method by name."""
        return {record.method: {k: v for k, v in record.to_dict().items() if k != "problem"} for record in self.records}

    def summary(self) -> dict[str, Any]:
        """Return the content of `summary.json`."""
        learned_from, heldout = self.problem.demonstrations, self.problem.heldout
        held = (heldout.trajectories, len(heldout)) if heldout else (0, 0)
        data = {"walks": learned_from.trajectories, "moves": len(learned_from)}
        return {
            "settings": asdict(self.config),
            "connectivity": self.problem.grid.connectivity,
            "data": {**data, "heldout_walks": held[0], "heldout_moves": held[1]},
            "methods": self.method_scores(),
        }


def compare_methods(
    grid: Grid,
    truth: Grid,
    walks: Walks,
    config: MapConfig,
    *,
    hold_out: float = 0.2,
    baselines: Mapping[str, Method] = BASELINES,
    annotations: WalkAnnotations = NO_ANNOTATIONS,
    notify: Callable[[str], None] = lambda _: None,
    **options: Any,
) -> Comparison:
    """Learn by every method from some of the walks, and evaluate the results.

    Behavior-aware modeling is `learn_map` with all that is known. The most probable goals of walks that do not name
    theirs hold for the baselines too. The baselines know nothing of sensors and persons.

    Args:
        grid: What is known of the map.
        truth: The true map.
        walks: The walks.
        config: The configuration.
        hold_out: The fraction of walks, drawn by the seed, that are scored and not learned from; may be 0.
        baselines: The baselines by name.
        annotations: As for `learn_map`.
        notify: Called with a line of text at each stage.
        **options: Other options of `learn_map`: `sensor`, `checkpoint` and `resume`.

    Returns:
        The scores of all methods, and the learned map.

    Raises:
        InputError: For a fraction that leaves no walk to learn from, or none to score though it is above 0; and as
            `learn_map` does.
    """
    for name, value, kind in (("grid", grid, Grid), ("truth", truth, Grid), ("walks", walks, Walks)):
        check_instance(value, kind, name)
    check_instance(config, MapConfig, "config")
    check_instance(annotations, WalkAnnotations, "annotations")
    message = f"expected the map's shape {grid.shape}, found {truth.shape}"
    check(truth.shape == grid.shape, message, field="truth")
    to_number(hold_out, "hold_out", least=0, below=1)
    walks, config = sample_walks(walks, config), replace(config, max_walks=None)
    train, test = _split(walks, hold_out, config.seed)
    notify("map: behavior learns")
    learned, failure = None, None
    try:
        learned = learn_map(grid, train, config, annotations=annotations, **options)
    except (ImproperTask, NotConverged) as error:
        failure = str(error)
    learning = learned.learning if learned else None
    moves = learning.goals.moves if learning and learning.goals else grid_walks(annotations.without_goals(train), grid)
    config = with_annotations(config, annotations)
    demonstrations, heldout = demonstrations_of(moves, grid, config), None
    if len(test):
        heldout_moves = grid_walks(annotations.without_goals(test), grid)
        heldout = demonstrations_of(_with_probable_goals(heldout_moves, learned), grid, config)
    problem = Problem("map", grid, truth, demonstrations, heldout)
    if learned and learning:
        notify("map: behavior is evaluated")
        result = _result_of(learned, demonstrations)
        own = run_method(problem, "behavior", lambda *_: result, seed=config.seed)
        if heldout and own.heldout_log_likelihood is not None and annotations.person_column:
            persons, person = persons_of(test, grid_walks(test, grid), annotations.person_column)
            mean = _by_person(result, learning, heldout, [str(persons[each]) for each in person])
            own = replace(own, heldout_log_likelihood=mean)
        records = [own if own.failure else replace(own, seconds=learning.seconds)]
    else:
        records = [Record(problem.name, "behavior", failure=failure)]
    methods = {name: (lambda *walks, method=method: method(*walks, config)) for name, method in baselines.items()}
    records += [run_method(problem, name, method, seed=config.seed, notify=notify) for name, method in methods.items()]
    return Comparison(problem, config, records, learned)


def _split(walks: Walks, hold_out: float, seed: int) -> tuple[Walks, Walks]:
    """Split walks into those to learn from and those held out."""
    held = round(hold_out * len(walks))
    valid = 0 <= held < len(walks) and (held == 0) == (hold_out == 0)
    check(valid, f"expected a fraction of the {len(walks)} walks, found {hold_out}", field="hold_out")
    drawn = np.random.default_rng(seed).permutation(len(walks))
    return walks.select(np.sort(drawn[held:])), walks.select(np.sort(drawn[:held]))


def _result_of(learned: LearnedMap, demonstrations: Demonstrations) -> ModelResult:
    """Return a learned map as the result of a method."""
    learning = learned.learning
    assert learning is not None
    result = model_result(learned.model, demonstrations, learning.config)
    agents = learning.fit.behavior
    logit, reward = agents.parameters.logit_discount, learning.config.reward
    if logit is not None:
        reward = replace(reward, discount=float(1 / (1 + np.exp(-np.asarray(logit)))))
    return result._replace(
        behavior=agents.behavior_of(), reward=reward, converged=learning.fit.converged, planner=learned.robot()
    )


def _by_person(result: ModelResult, learning: Learning, heldout: Demonstrations, names: list[str]) -> float | None:
    """Return the mean log π of held-out moves by the behavior of each trajectory's person; new persons are typical."""
    learned, of_moves = list(learning.persons), np.array(names)[np.asarray(heldout.trajectory)]
    log_policies = np.zeros(len(heldout))
    for name in sorted(set(names)):
        behavior = learning.fit.behavior.behavior_of(learned.index(name) if name in learned else None)
        own = of_moves == name
        log_policies[own] = result._replace(behavior=behavior).log_policies(heldout)[own]
    return float(log_policies.mean()) if np.isfinite(log_policies).all() else None


def _with_probable_goals(moves: Moves, learned: LearnedMap | None) -> Moves:
    """Return held-out moves; where walks do not name their goals, with the most probable candidate of each."""
    learning = learned.learning if learned else None
    if learned is None or learning is None or learning.goals is None:
        return moves
    posterior, config = learning.goals, learning.config
    tasks = [config.reward.reach(learned.grid, int(state)) for state in posterior.candidates]
    behavior, walks = behavior_of(config), moves.trajectories()
    probability, _ = goal_posterior(learned.model, walks, tasks, behavior, posterior.fit.goal_probabilities)
    goals = moves.goals.copy()
    goals[np.unique(moves.walk)] = posterior.candidates[probability.argmax(axis=1)]
    return replace(moves, goals=goals)
