"""A study: methods that learn from the same walks, evaluated by the same scores on several problems."""

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from sidestep.errors import ImproperTask, NotConverged, check, check_function, check_instance
from sidestep.evaluation.evaluate import Evaluation, evaluate
from sidestep.evaluation.reliability import Reliability, map_reliability
from sidestep.robots.planners import Planner
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Cell, Grid


@runtime_checkable
class MethodResult(Protocol):
    """What a method has learned, as far as a study evaluates it."""

    @property
    def planner(self) -> Planner:
        """The robot's planner."""
        ...

    @property
    def ranking(self) -> Float[np.ndarray, "rows columns"] | None:
        """A number for each cell, higher for obstacles; None if the method does not rank cells."""
        ...

    @property
    def ranks_by_probability(self) -> bool:
        """Whether these numbers are P(blocked), and can be scored as such."""
        ...

    @property
    def converged(self) -> bool:
        """Whether the method's optimization converged; True if it has none."""
        ...

    def log_policies(self, demonstrations: Demonstrations) -> Float[np.ndarray, " moves"]:
        """Return log π(a | s) of every move in nats; NaN for all moves if the values of a task do not converge.

        Args:
            demonstrations: Moves on the same map.
        """
        ...


Method = Callable[[Grid, Demonstrations], MethodResult]
"""A method: it learns from demonstrations on a map."""
Notify = Callable[[str], None]
"""Called with a line of text at each stage."""


@dataclass(frozen=True, eq=False)
class Problem:
    """A map to learn, with demonstrations and the true map.

    Attributes:
        name: The name in the records.
        grid: The known map. Its unknown cells are scored.
        truth: The true map.
        demonstrations: The demonstrations to learn from.
        heldout: Demonstrations for the predictive log-likelihood; None to leave it out.
        goals: The goals of evaluated paths (states); None for all free cells.
    """

    name: str
    grid: Grid
    truth: Grid
    demonstrations: Demonstrations
    heldout: Demonstrations | None = None
    goals: Int[np.ndarray, " goals"] | None = None


@dataclass(frozen=True, eq=False)
class Record:
    """The result of one method on one problem.

    Attributes:
        problem: The problem's name.
        method: The method's name.
        evaluation: The scores; all None if the method failed. Those of calibration are None also if the method ranks
            cells by other numbers than P(blocked).
        reliability: The reliability of P(blocked) over the scored cells; None where there is no calibration error.
        heldout_log_likelihood: The mean log π(a | s) of held-out moves in nats; None without held-out moves and if a
            value does not converge.
        seconds: The time of learning; None if the method failed.
        converged: As in `MethodResult`; None if the method failed.
        failure: Why the method failed; None if it did not.
        result: What the method learned; None if it failed.
    """

    problem: str
    method: str
    evaluation: Evaluation = field(default_factory=Evaluation)
    reliability: Reliability | None = None
    heldout_log_likelihood: float | None = None
    seconds: float | None = None
    converged: bool | None = None
    failure: str | None = None
    result: MethodResult | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return all but `result` and `reliability` by name, the scores among them."""
        left_out = "evaluation", "reliability", "result"
        others = {name: value for name, value in vars(self).items() if name not in left_out}
        return {**others, **self.evaluation.to_dict()}


def run_study(problems: Iterable[Problem], methods: Mapping[str, Method], **options: Any) -> list[Record]:
    """Learn from every problem by every method, and evaluate the results.

    A method fails if it raises `ImproperTask` or `NotConverged`; the others go on.

    Args:
        problems: The problems; they may be made one at a time.
        methods: The methods by name.
        **options: Options of `run_method`.

    Returns:
        A record for each problem and method, problem by problem.

    Raises:
        InputError: For problems with parts that do not fit each other.
    """
    return [run_method(each, name, learn, **options) for each in problems for name, learn in methods.items()]


def run_method(
    problem: Problem, name: str, learn: Method, *, seed: int = 0, paths: bool = True, notify: Notify = lambda _: None
) -> Record:
    """Learn from one problem by one method, and evaluate the result.

    Args:
        problem: The problem.
        name: The name of the method in the record.
        learn: The method.
        seed: The seed of `evaluate`.
        paths: Whether to evaluate planned paths; otherwise cells only, which takes much less time.
        notify: Called with a line of text before the method learns and before it is evaluated.

    Returns:
        The record; without scores if the method raises `ImproperTask` or `NotConverged`.
    """
    check_instance(problem, Problem, "problem")
    check_function(learn, "learn")
    label, visited = f"{problem.name}: {name}", problem.demonstrations.visited_state_goals()
    try:
        notify(f"{label} learns")
        started = time.monotonic()
        result = learn(problem.grid, problem.demonstrations)
        seconds = round(time.monotonic() - started, 3)
        notify(f"{label} is evaluated")
        scored = problem.grid.known == Cell.UNKNOWN
        planner = result.planner if paths else None
        scores = evaluate(planner, result.ranking, problem.truth, scored, visited, seed, goals=problem.goals)
    except (ImproperTask, NotConverged) as error:
        return Record(problem.name, name, failure=str(error))
    bins = map_reliability(result.ranking, problem.truth, scored) if result.ranks_by_probability else None
    if bins is None:
        # such as costs, which may happen to lie in [0, 1]
        scores = replace(scores, calibration_error=None, brier_score=None, log_loss=None)
    heldout = None if problem.heldout is None else mean_log_likelihood(result, problem.heldout)
    return Record(problem.name, name, scores, bins, heldout, seconds, result.converged, result=result)


def mean_log_likelihood(result: MethodResult, demonstrations: Demonstrations) -> float | None:
    """Return the weighted mean of log π(a | s) over moves in nats; None if the values of a task do not converge.

    Args:
        result: What a method learned.
        demonstrations: Moves on the same map.
    """
    weights = np.asarray(demonstrations.weights)
    check((weights > 0).any(), "expected at least one move that counts, found none", field="demonstrations")
    mean = float(np.average(result.log_policies(demonstrations)[weights > 0], weights=weights[weights > 0]))
    return mean if np.isfinite(mean) else None
