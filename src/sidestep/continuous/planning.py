"""Planning in continuous worlds: a policy that is improved until it is people's own (`planner` has the mathematics)."""

from collections.abc import Callable
from typing import Generic

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Int, PRNGKeyArray, Shaped

from sidestep.continuous.dynamics import Dynamics, check_finite
from sidestep.continuous.estimators import surprised
from sidestep.continuous.planner import Planner, Planning, PlanProgress, SomePolicy, check_planner
from sidestep.continuous.tasks import ContinuousTask, check_tasks, ended_at, task_at
from sidestep.errors import InputError, NotConverged, check_count
from sidestep.tabular.backups import Behavior


class Plan(eqx.Module, Generic[SomePolicy]):
    """A policy that was found, and how: `history` has one `PlanProgress` a step."""

    planning: Planning[SomePolicy]
    history: tuple[PlanProgress, ...] = eqx.field(static=True)

    @property
    def policy(self) -> SomePolicy:
        """The policy."""
        return self.planning.policy

    def lately(self, steps: int = 50) -> PlanProgress:
        """The mean of the last steps' figures, which are noisy one by one."""
        last = np.asarray(self.history[-steps:])
        return PlanProgress(int(last[-1, 0]), *last[:, 1:].mean(axis=0).tolist())


def plan(
    dynamics: Dynamics,
    tasks: ContinuousTask,
    behavior: Behavior,
    policy: SomePolicy,
    states: Shaped[Array, "starts *state"],
    task: Int[Array, " starts"],
    planner: Planner,
    *,
    steps: int,
    seed: int = 0,
    warm: Planning[SomePolicy] | None = None,
    report: Callable[[PlanProgress], None] | None = None,
) -> Plan[SomePolicy]:
    """The policy of people who know `dynamics`, found by gradients from the places `states`.

    - `tasks`: all tasks, stacked; `task`: which of them each place belongs to.
    - `policy`: where to begin; or `warm`, the planning of an earlier call (its policy, critic and moments).
    - `steps`: how many steps are taken.
    - `report`: called after each of them.

    Raises `InputError` for places that are not finite or where a task has ended, tasks that are not there, parameters
    that are not finite, settings below 1 and mellowmax people whose actions are vectors; `NotConverged` if numbers
    cease to be finite.
    """
    check_planner(planner)
    check_tasks(tasks)
    check_places(states, task, tasks)
    check_finite(dynamics.parameters)
    check_count(steps, 1, "steps")
    beginning, key = jax.random.split(jax.random.key(seed))
    all_tasks = task_at(tasks, task)
    planning = warm or planner.begin(beginning, dynamics, policy, all_tasks, behavior, states)
    history = []
    for iteration in range(steps):
        planning, progress = _plan_step(
            planner, planning, dynamics, all_tasks, behavior, jax.random.fold_in(key, iteration), states
        )
        history.append(PlanProgress(iteration, *(float(number) for number in progress[1:])))
        if not np.isfinite(history[-1]).all():
            raise NotConverged(
                f"the policy's figures ceased to be finite at step {iteration}: dynamics or rewards that return NaN, "
                "or too high a rate"
            )
        if report:
            report(history[-1])
    return Plan(planning, tuple(history))


@eqx.filter_jit
def _plan_step(
    planner: Planner,
    planning: Planning[SomePolicy],
    dynamics: Dynamics,
    tasks: ContinuousTask,
    behavior: Behavior,
    key: PRNGKeyArray,
    states: Shaped[Array, "starts *state"],
) -> tuple[Planning[SomePolicy], PlanProgress]:
    choosing, drawing, rolling = jax.random.split(key, 3)
    places = jax.random.choice(choosing, len(states), (planner.places,), replace=len(states) < planner.places)
    own, here = task_at(tasks, places), states[places]
    choices, shares = planner.tried(drawing, planning.policy, own, here)
    rolled = planner.roll(dynamics, planning.policy, own, behavior, rolling, here, choices)
    rolled = surprised(dynamics, planning.policy, own, rolled, planning.critic)
    return planner.improve(planning, own, behavior, rolled, shares)


def check_places(states: Shaped[Array, "places *state"], task: Int[Array, " places"], tasks: ContinuousTask) -> None:
    """Raises `InputError` unless there are places, all finite, with tasks that exist and have not ended there."""
    count = len(tasks.discount)
    if len(states) == 0 or len(task) != len(states):
        raise InputError(f"expected places and a task for each, found {len(states)} and {len(task)}", field="states")
    wrong = ~np.isfinite(states).reshape(len(states), -1).all(axis=1)
    if wrong.any():
        raise InputError("expected finite numbers", source="states", row=int(wrong.argmax()) + 1)
    if int(task.min()) < 0 or int(task.max()) >= count:
        raise InputError(f"expected tasks in 0…{count - 1}", field="task")
    ended = ended_at(tasks, task, states)
    if ended.any():
        row = int(ended.argmax()) + 1
        raise InputError("expected places where a task has not ended", source="states", row=row)
