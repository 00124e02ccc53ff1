"""What a Metropolis chain over barriers knows of the world and of demonstrations, as native code reads it."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from sidestep.errors import check
from sidestep.inference.chain_kernels import Evidence, World
from sidestep.tabular.backups import Behavior
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Cell
from sidestep.tabular.likelihood import Terms
from sidestep.tabular.models.barriers import NO_BARRIER, Barriers
from sidestep.tabular.tasks import Task

PASSING = (0.997, 0.003)
"""The probability that an open barrier, and a closed one, lets an agent pass."""
TOLERANCE = 7e-4
"""The change of β V that is passed on (nats)."""


def world_of(barriers: Barriers) -> World:
    """Return barriers with what depends on which.

    Args:
        barriers: The barriers.
    """
    passing = np.where(
        (barriers.known == Cell.UNKNOWN)[:, None], PASSING, np.where(barriers.known == Cell.FREE, 1.0, 0.0)[:, None]
    )
    states = np.arange(len(barriers.successors))
    needed = barriers.needed
    state = np.nonzero(needed != NO_BARRIER)[0]
    gated_begin, gated = _grouped(needed[needed != NO_BARRIER], state, len(barriers.known))
    leads = (barriers.attempts > 0) & (barriers.successors != states[:, None, None])
    before_begin, before = _grouped(barriers.successors[leads], np.nonzero(leads)[0], len(states))
    successors = np.where(_possible(barriers), barriers.successors, states[:, None, None])
    return World(
        successors.astype(np.int32), barriers.attempts, needed.astype(np.int32), passing,
        gated_begin, gated, before_begin, before,
    )  # fmt: skip


def evidence_of(
    barriers: Barriers,
    demonstrations: Demonstrations,
    tasks: Task,
    behaviors: Sequence[Behavior],
    available: Bool[np.ndarray, "states actions"],
    weight: float,
    terms: Terms,
) -> Evidence:
    """Return the tasks, with the behavior of each, and the observed moves.

    Args:
        barriers: The barriers.
        demonstrations: The moves.
        tasks: The tasks as the agents see them.
        behaviors: The behavior in each task.
        available: Whether each action is available in each state.
        weight: That of the actions.
        terms: The parts of the likelihood that count.
    """
    discount, reward = np.array(tasks.discount, np.float64), np.array(tasks.reward, np.float64)
    moved, stayed = _transitions(barriers, demonstrations, terms)
    choice_row, choices = _choices(demonstrations, barriers.successors.shape[1])
    beta = np.array([float(each.beta) for each in behaviors])
    return Evidence(
        reward=reward if available.all() else np.where(available, reward, -np.inf),
        choosable=available.sum(axis=1),
        solved=_solvable(barriers, np.array(tasks.terminal), discount),
        discount=discount,
        beta=beta,
        lapse=np.array([0.0 if each.lapse is None else float(each.lapse) for each in behaviors]),
        tolerance=TOLERANCE / beta,
        choice_row=choice_row,
        choices=weight * choices,
        moved=moved,
        stayed=stayed,
        has_transitions=np.asarray(moved.any(axis=(1, 2)) | stayed.any(axis=1)),
    )


def _grouped(keys: np.ndarray, items: np.ndarray, groups: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct items of each key, one group after another, and where each group begins."""
    pairs = np.unique(np.stack([keys, items], axis=1), axis=0)
    begin = np.searchsorted(pairs[:, 0], np.arange(groups + 1))
    return begin.astype(np.int64), pairs[:, 1].astype(np.int64)


def _solvable(barriers: Barriers, terminal: np.ndarray, discount: np.ndarray) -> np.ndarray:
    """Return whether each task goes on in each state and its value is finite, were all unknown barriers open.

    At discount 1 this is where a task can end from, below 1 everywhere.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order

    possible = _possible(barriers)
    state = np.nonzero(possible)[0]
    size = len(possible)
    solvable = np.zeros(terminal.shape, bool)
    for task, ends in enumerate(terminal):
        # one more state leads to every end
        rows = np.concatenate([barriers.successors[possible], np.full(ends.sum(), size)])
        columns = np.concatenate([state, np.flatnonzero(ends)])
        graph = csr_array((np.ones(len(rows)), (rows, columns)), shape=(size + 1, size + 1))
        reached = breadth_first_order(graph, size, return_predecessors=False)
        solvable[task, reached[reached < size]] = True
    return (solvable | (discount < 1)[:, None]) & ~terminal


def _possible(barriers: Barriers) -> Bool[np.ndarray, "states actions attempts"]:
    """Return whether each attempt can succeed, were all unknown barriers open."""
    closed = np.append(barriers.known == Cell.OCCUPIED, False)
    return (barriers.attempts > 0) & ~closed[barriers.needed].any(axis=-1)


def _transitions(barriers: Barriers, demonstrations: Demonstrations, terms: Terms) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights of observed transitions by each attempt, and of those that stayed."""
    moved, stayed = np.zeros(barriers.successors.shape), np.zeros(barriers.successors.shape[:2])
    if "transitions" not in terms:
        return moved, stayed
    s, a, after, weight = (
        np.asarray(each)
        for each in (demonstrations.states, demonstrations.actions, demonstrations.next_states, demonstrations.weights)
    )
    stays = s == after
    np.add.at(stayed, (s[stays], a[stays]), weight[stays])
    s, a, after, weight = (each[~stays] for each in (s, a, after, weight))
    leads = (barriers.successors[s, a] == after[:, None]) & _possible(barriers)[s, a]
    check(leads.any(axis=-1).all(), "expected transitions that the model allows", field="demonstrations")
    np.add.at(moved, (s, a, leads.argmax(axis=-1)), weight)
    return moved, stayed


def crossed_barriers(barriers: Barriers, demonstrations: Demonstrations, terms: Terms) -> Bool[np.ndarray, " barriers"]:
    """Return the barriers that agents crossed, and where these are cells, those that agents were in; they are open.

    Args:
        barriers: The barriers.
        demonstrations: The moves; those of weight 0 do not count.
        terms: The parts of the likelihood that count; without transitions nothing is crossed.
    """
    crossed = np.zeros(len(barriers.known) + 1, bool)
    if "transitions" in terms:
        crossed[barriers.needed[_transitions(barriers, demonstrations, terms)[0] > 0]] = True
        if barriers.shape is not None:
            counts = np.asarray(demonstrations.weights) > 0
            for each in (demonstrations.states, demonstrations.next_states):
                crossed[np.asarray(each)[counts]] = True
    return crossed[:-1] & (barriers.known == Cell.UNKNOWN)


def _choices(demonstrations: Demonstrations, actions: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the row of each task and state in which actions were observed, and the weight of each action there."""
    task, s, a, weight = (
        np.asarray(each)
        for each in (demonstrations.task, demonstrations.states, demonstrations.actions, demonstrations.weights)
    )
    shape = np.asarray(demonstrations.tasks.terminal).shape
    row, flat = np.full(shape, -1, np.int32), task.astype(np.int64) * shape[1] + s
    distinct, which = np.unique(flat, return_inverse=True)
    row.reshape(-1)[distinct] = np.arange(len(distinct))
    choices = np.zeros((len(distinct), actions))
    np.add.at(choices, (which, a), weight)
    return row, choices
