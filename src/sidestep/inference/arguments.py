"""Checks of the arguments that fits, samplers and exact posteriors share."""

from collections.abc import Sequence

from sidestep.errors import check, check_instance, to_list, to_number
from sidestep.tabular.backups import Behavior
from sidestep.tabular.behavior_model import BehaviorModel
from sidestep.tabular.checks import check_behavior, check_demonstrations, check_model, check_persons
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.likelihood import ALL_TERMS, Terms, check_terms
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.tasks import Task


def check_evidence(
    model: TransitionModel,
    demonstrations: Demonstrations,
    behavior: Behavior | BehaviorModel,
    tempering: float = 1.0,
    terms: Terms = ALL_TERMS,
) -> None:
    """Check what a transition model is learned from.

    Args:
        model: The transition model.
        demonstrations: Demonstrations in its world.
        behavior: The behavior of the agents, or a model of it.
        tempering: κ in (0, 1].
        terms: The parts of the likelihood that count.

    Raises:
        InputError: For arguments of another type, demonstrations in another world, and numbers out of range.
    """
    to_number(tempering, "tempering", above=0, most=1)
    check_terms(terms)
    check_model(model)
    check_behavior(behavior, model.graph)
    check_demonstrations(demonstrations, model.graph)
    check_persons(behavior, len(demonstrations.tasks.terminal))


def check_tasks(model: TransitionModel, tasks: Sequence[Task], field: str) -> list[Task]:
    """Return a list of tasks in the world of a transition model.

    Args:
        model: The transition model.
        tasks: At least one task.
        field: The argument, for the error.

    Raises:
        InputError: For arguments of another type, no task, and another number of states.
    """
    check_instance(model, TransitionModel, "model")
    states, elements = model.graph.states, to_list(tasks, Task, field)
    for each in elements:
        message = f"expected tasks of {states} states, found shape {each.terminal.shape}"
        check(each.terminal.shape == (states,), message, field=field)
    return elements
