"""Checks of the arguments that fits, samplers and exact posteriors share."""

from collections.abc import Sequence

import numpy as np

from sidestep.errors import check, check_instance, describe, to_list, to_number
from sidestep.tabular.backups import Behavior
from sidestep.tabular.behavior_model import BehaviorModel
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.likelihood import ALL_TERMS, Terms
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
    check_instance(behavior, (Behavior, BehaviorModel), "behavior")
    to_number(tempering, "tempering", above=0, most=1)
    known = isinstance(terms, tuple | list) and len(terms) > 0 and all(term in ALL_TERMS for term in terms)
    check(known, f"expected one or both of {ALL_TERMS}, found {describe(terms)}", field="terms")
    check_world(model, demonstrations)


def check_world(model: TransitionModel, demonstrations: Demonstrations) -> None:
    """Check that demonstrations were made in the world of a transition model.

    Args:
        model: The transition model.
        demonstrations: The demonstrations.

    Raises:
        InputError: For arguments of another type, and other numbers of states and actions.
    """
    check_instance(model, TransitionModel, "model")
    check_instance(demonstrations, Demonstrations, "demonstrations")
    check_instance(demonstrations.tasks, Task, "demonstrations")
    states, actions = demonstrations.tasks.terminal.shape[-1], np.asarray(demonstrations.actions)
    graph, last = model.graph, int(actions.max(initial=-1))
    fits = states == graph.states and last < graph.actions and actions.dtype.kind in "iu"
    message = f"expected the model's {graph.states} states and {graph.actions} actions, found {states} states and "
    check(fits, f"{message}actions up to {last}", field="demonstrations")


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
