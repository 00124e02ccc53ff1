"""A Markov chain over barriers, as native code (numba): proposals, values after a proposal, and the acceptance.

`sampler` describes the chain. The native code does three things for a proposal that the prior has accepted:

1. **Local value iteration.** A changed barrier changes the transitions of a few states. These are solved anew, each by
   a Newton step on its own equation (`value_kernels.own_root`), and the states with an action that leads to a state
   that has changed by more than a tolerance follow, first in, first out. This is asynchronous value iteration with an
   active list; it differs from prioritized sweeping (Moore & Atkeson 1993) by the order.
2. **The likelihood.** The log-probabilities of the choices in solved states are computed anew, and the probabilities
   of the transitions out of changed states.
3. **Undoing.** The old values are kept until the proposal is accepted, and restored otherwise.

A mean field follows changes of probabilities by the same steps (`ascend`; see `coordinate_ascent`).
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from sidestep.inference.prior_kernels import closing_prior, flip_prior, propose
from sidestep.tabular.solvers.native import NativeBackup, NativeFunction, compiled, part
from sidestep.tabular.solvers.value_kernels import Scratch, own_root

_FAST = {"contract", "reassoc", "nsz", "arcp"}
_own_root = own_root.as_part()


class World(NamedTuple):
    """The barriers of a model, and what depends on which, as native code reads them.

    Attributes:
        successors: As in `Barriers`, but the state itself for attempts that cannot succeed, so that no value of −∞ is
            multiplied by 0.
        attempts, needed: As in `Barriers`.
        passing: o(i) of a barrier that is open, and of one that is closed.
        gated: The states with an action that needs barrier i are `gated[gated_begin[i] : gated_begin[i + 1]]`.
        before: The states with an action that may lead to s are `before[before_begin[s] : before_begin[s + 1]]`.
    """

    successors: np.ndarray
    attempts: np.ndarray
    needed: np.ndarray
    passing: np.ndarray
    gated_begin: np.ndarray
    gated: np.ndarray
    before_begin: np.ndarray
    before: np.ndarray


class Evidence(NamedTuple):
    """The tasks and the moves that were observed.

    Attributes:
        reward: R(s, a) of each task; an axis of length 1 holds for all states or all actions. −∞ for actions that are
            not available.
        choosable: The number of available actions in each state.
        solved: Whether each task goes on in each state and a terminal state can be reached from there.
        discount, beta, lapse, tolerance: Of each task; the tolerance is one of values.
        choice_row: The row of `choices` for each task and state; −1 where no action was observed.
        choices: The weight of each action there.
        moved: The weight of the transitions by each attempt.
        stayed: The weight of those that stayed, by each action.
        has_transitions: Whether transitions out of each state were observed.
    """

    reward: np.ndarray
    choosable: np.ndarray
    solved: np.ndarray
    discount: np.ndarray
    beta: np.ndarray
    lapse: np.ndarray
    tolerance: np.ndarray
    choice_row: np.ndarray
    choices: np.ndarray
    moved: np.ndarray
    stayed: np.ndarray
    has_transitions: np.ndarray


class Chain(NamedTuple):
    """The state of a chain, changed in place.

    Attributes:
        closed: z, whether each barrier is closed (0 or 1).
        passing: The probability that each barrier lets an agent pass: o(i), or its mean in a mean field.
        probs: The probability of each attempt's success.
        values: V of each task; −∞ in states from which it cannot end. An action that may lead there is worth −∞ and is
            never taken. Which states these are depends on known barriers only: a closed one that is not known lets
            agents pass, if rarely.
        row_log_likelihood: The log-likelihood of the choices in each row.
        totals: The log-likelihood of all choices and of all transitions.
    """

    closed: np.ndarray
    passing: np.ndarray
    probs: np.ndarray
    values: np.ndarray
    row_log_likelihood: np.ndarray
    totals: np.ndarray


class Workspace(NamedTuple):
    """Memory of a chain: the active list, what has to be undone, and which states are in it.

    Attributes:
        queue: The active list, a ring.
        queued: Whether each state is in it.
        sources: The states with transitions that a proposal changes.
        marked: The number of the proposal that last marked each state as a source.
        log_task, log_state, log_value: Old values.
        logged: The number of the proposal that last logged each task's state.
        log_row, log_row_value: Old log-likelihoods of rows.
        changed: The barriers that a proposal changes.
        counters: The number of the proposal, the sizes of both logs and of `sources`, and the number of backups.
    """

    queue: np.ndarray
    queued: np.ndarray
    sources: np.ndarray
    marked: np.ndarray
    log_task: np.ndarray
    log_state: np.ndarray
    log_value: np.ndarray
    logged: np.ndarray
    log_row: np.ndarray
    log_row_value: np.ndarray
    changed: np.ndarray
    counters: np.ndarray


class ChainKernels(NamedTuple):
    """The native code of a chain.

    Attributes:
        refresh: Compute everything from the barriers.
        sweep: Make proposals, and accept or reject each.
        ascend: Update P(closed) of each barrier of a mean field (`coordinate_ascent`).
    """

    refresh: NativeFunction
    sweep: NativeFunction
    ascend: NativeFunction


PROPOSAL, LOGGED, LOGGED_ROWS, SOURCES, BACKUPS = range(5)
"""The places of `Workspace.counters`."""


# The likelihood


@part(fastmath=_FAST)
def _transition_log_likelihood(s, actions, width, probs, evidence):  # pragma: no cover
    """Return the log-likelihood of the observed transitions out of a state."""
    total = 0.0
    for a in range(actions):
        success = 0.0
        for k in range(width):
            success += probs[s, a, k]
            if evidence.moved[s, a, k] > 0:
                total += evidence.moved[s, a, k] * np.log(probs[s, a, k])
        if evidence.stayed[s, a] > 0:
            total += evidence.stayed[s, a] * np.log(max(1 - success, 1e-300))
    return total


@part(fastmath=_FAST)
def _choice_log_likelihood(actions, available, lapse, beta, counts, advantages):  # pragma: no cover
    """Return the log-likelihood of the observed choices in a state from the advantages of its actions.

    `available` is the number of actions that lapses choose from.
    """
    best = advantages[0]
    for a in range(1, actions):
        best = max(best, advantages[a])
    total = 0.0
    for a in range(actions):
        total += np.exp(max(beta * (advantages[a] - best), -700.0))
    result = 0.0
    for a in range(actions):
        if counts[a] > 0:
            chosen = beta * (advantages[a] - best) - np.log(total)
            if lapse > 0:
                chosen = np.log((1 - lapse) * np.exp(max(chosen, -700.0)) + lapse / available)
            result += counts[a] * chosen
    return result


@cache
def chain_kernels(actions: int, width: int) -> ChainKernels:
    """Return the native code for worlds with a number of actions, and of attempts at each."""

    @part(fastmath=_FAST)
    def fill(task, s, world, evidence, chain, scratch):  # pragma: no cover
        """Fill in c(a) and l(a) of a state (see `base`); return its repeat-action value."""
        discount = evidence.discount[task]
        row = s if evidence.reward.shape[1] > 1 else 0
        repeat_value = -np.inf
        for a in range(actions):
            exit_value = evidence.reward[task, row, a if evidence.reward.shape[2] > 1 else 0]
            weight = 1 - discount
            for k in range(width):
                j = world.successors[s, a, k]
                if j != s:
                    move = discount * chain.probs[s, a, k]
                    exit_value += move * chain.values[task, j]
                    weight += move
            scratch.exit_values[a] = exit_value
            scratch.exit_weights[a] = weight
            if weight > 0:
                repeat_value = max(repeat_value, exit_value / weight)
        return repeat_value

    @part(fastmath=_FAST)
    def settle(task, count, world, evidence, chain, work, kind, tie, scratch):  # pragma: no cover
        """Solve the states in the active list, and those that depend on what changes, until nothing does."""
        beta, tolerance = evidence.beta[task], evidence.tolerance[task]
        backup = NativeBackup(kind, beta, tie)
        states, head = chain.values.shape[1], 0
        while count > 0:
            s = np.int64(work.queue[head])
            head = head + 1 if head + 1 < states else 0
            count -= 1
            work.queued[s] = False
            work.counters[BACKUPS] += 1
            old = chain.values[task, s]
            repeat_value = fill(task, s, world, evidence, chain, scratch)
            value = -np.inf
            if repeat_value > -np.inf:
                guess = old if old > -np.inf else repeat_value
                value = _own_root(actions, backup, evidence.choosable[s], guess, repeat_value, scratch)
            if work.logged[task, s] != work.counters[PROPOSAL]:
                at = work.counters[LOGGED]
                work.log_task[at], work.log_state[at], work.log_value[at] = task, s, old
                work.logged[task, s] = work.counters[PROPOSAL]
                work.counters[LOGGED] += 1
            if value != old and abs(value - old) > tolerance:
                chain.values[task, s] = value
                for at in range(world.before_begin[s], world.before_begin[s + 1]):
                    j = world.before[at]
                    if evidence.solved[task, j] and not work.queued[j]:
                        work.queued[j] = True
                        tail = head + count
                        work.queue[tail if tail < states else tail - states] = j
                        count += 1

    @part(fastmath=_FAST)
    def choices_in(task, s, world, evidence, chain, scratch):  # pragma: no cover
        """Return the log-likelihood of the choices in a state for a task.

        Where the task cannot end from, all available actions are as good.
        """
        value = chain.values[task, s]
        if value > -np.inf:
            fill(task, s, world, evidence, chain, scratch)
            for a in range(actions):
                scratch.advantages[a] = scratch.exit_values[a] - scratch.exit_weights[a] * value
        else:
            row = s if evidence.reward.shape[1] > 1 else 0
            for a in range(actions):
                reward = evidence.reward[task, row, a if evidence.reward.shape[2] > 1 else 0]
                scratch.advantages[a] = 0.0 if reward > -np.inf else -np.inf
        counts = evidence.choices[evidence.choice_row[task, s]]
        rules = evidence.choosable[s], evidence.lapse[task], evidence.beta[task]
        return _choice_log_likelihood(actions, *rules, counts, scratch.advantages)

    @part(fastmath=_FAST)
    def refresh_probs(s, world, chain):  # pragma: no cover
        """Compute the probabilities of the attempts out of a state from the barriers."""
        for a in range(actions):
            for k in range(width):
                success = world.attempts[s, a, k]
                for n in range(world.needed.shape[3]):
                    i = world.needed[s, a, k, n]
                    if i >= 0:
                        success *= chain.passing[i]
                chain.probs[s, a, k] = success

    @compiled()
    def refresh(world, evidence, chain, work, kind, tie):  # pragma: no cover
        """Compute the probabilities, values and log-likelihoods of a chain from its barriers and values nearby."""
        scratch = Scratch(np.empty(actions), np.empty(actions), np.empty(actions))
        tasks, states = chain.values.shape
        chain.totals[:] = 0.0
        for s in range(states):
            refresh_probs(s, world, chain)
            if evidence.has_transitions[s]:
                chain.totals[1] += _transition_log_likelihood(s, actions, width, chain.probs, evidence)
        for task in range(tasks):
            work.counters[PROPOSAL] += 1
            work.counters[LOGGED] = 0
            count = 0
            for s in range(states):
                if evidence.solved[task, s]:
                    work.queue[count] = s
                    work.queued[s] = True
                    count += 1
            settle(task, np.int64(count), world, evidence, chain, work, kind, tie, scratch)
            for s in range(states):
                row = evidence.choice_row[task, s]
                if row >= 0:
                    chain.row_log_likelihood[row] = choices_in(task, s, world, evidence, chain, scratch)
                    chain.totals[0] += chain.row_log_likelihood[row]

    @part(fastmath=_FAST)
    def change_transitions(count, world, evidence, chain, work):  # pragma: no cover
        """Compute what depends on changed barriers directly; return the change of the transitions' log-likelihood."""
        work.counters[SOURCES] = 0
        change = 0.0
        for n in range(count):
            i = work.changed[n]
            for at in range(world.gated_begin[i], world.gated_begin[i + 1]):
                s = world.gated[at]
                if work.marked[s] != work.counters[PROPOSAL]:
                    work.marked[s] = work.counters[PROPOSAL]
                    work.sources[work.counters[SOURCES]] = s
                    work.counters[SOURCES] += 1
                    if evidence.has_transitions[s]:
                        change -= _transition_log_likelihood(s, actions, width, chain.probs, evidence)
                    refresh_probs(s, world, chain)
                    if evidence.has_transitions[s]:
                        change += _transition_log_likelihood(s, actions, width, chain.probs, evidence)
        return change

    @part(fastmath=_FAST)
    def change_choices(task, world, evidence, chain, work, kind, tie, scratch):  # pragma: no cover
        """Solve a task after a change of transitions; return the change of the choices' log-likelihood."""
        first, count = work.counters[LOGGED], 0
        for n in range(work.counters[SOURCES]):
            s = work.sources[n]
            if evidence.solved[task, s]:
                work.queue[count] = s
                work.queued[s] = True
                count += 1
        settle(task, np.int64(count), world, evidence, chain, work, kind, tie, scratch)
        change = 0.0
        for at in range(first, work.counters[LOGGED]):
            s = work.log_state[at]
            row = evidence.choice_row[task, s]
            if row >= 0:
                place, old = work.counters[LOGGED_ROWS], chain.row_log_likelihood[row]
                work.log_row[place], work.log_row_value[place] = row, old
                work.counters[LOGGED_ROWS] += 1
                chain.row_log_likelihood[row] = choices_in(task, s, world, evidence, chain, scratch)
                change += chain.row_log_likelihood[row] - old
        return change

    @part(fastmath=_FAST)
    def change(count, world, evidence, chain, work, kind, tie, scratch):  # pragma: no cover
        """Follow the change of `count` barriers; return how the log-likelihoods of choices and transitions change."""
        work.counters[PROPOSAL] += 1
        work.counters[LOGGED] = 0
        work.counters[LOGGED_ROWS] = 0
        of_transitions = change_transitions(count, world, evidence, chain, work)
        of_choices = 0.0
        for task in range(chain.values.shape[0]):
            of_choices += change_choices(task, world, evidence, chain, work, kind, tie, scratch)
        return of_choices, of_transitions

    @part()
    def undo(world, chain, work):  # pragma: no cover
        """Restore what followed the last change of barriers; these are already as they were."""
        for n in range(work.counters[SOURCES]):
            refresh_probs(work.sources[n], world, chain)
        for at in range(work.counters[LOGGED]):
            chain.values[work.log_task[at], work.log_state[at]] = work.log_value[at]
        for at in range(work.counters[LOGGED_ROWS]):
            chain.row_log_likelihood[work.log_row[at]] = work.log_row_value[at]

    @compiled()
    def sweep(
        rng, proposals, heat, free, is_free, world, evidence, prior, kinds, chain, work, kind, tie
    ):  # pragma: no cover
        """Make proposals and accept or reject each; return the number that were accepted."""
        scratch = Scratch(np.empty(actions), np.empty(actions), np.empty(actions))
        accepted = 0
        for _ in range(proposals):
            count = propose(rng, free, is_free, chain.closed, prior, kinds, work.changed)
            if count == 0:
                continue
            gain = 0.0
            for n in range(count):
                gain += flip_prior(chain.closed, work.changed[n], prior)
            if np.log(rng.random()) * heat > gain:
                for n in range(count):
                    chain.closed[work.changed[n]] = 1 - chain.closed[work.changed[n]]
                continue
            threshold = np.log(rng.random()) * heat
            for n in range(count):
                i = work.changed[n]
                chain.passing[i] = world.passing[i, chain.closed[i]]
            of_choices, of_transitions = change(count, world, evidence, chain, work, kind, tie, scratch)
            if of_transitions + of_choices >= threshold:
                chain.totals[0] += of_choices
                chain.totals[1] += of_transitions
                accepted += 1
            else:
                for n in range(count):
                    i = work.changed[n]
                    chain.closed[i] = 1 - chain.closed[i]
                    chain.passing[i] = world.passing[i, chain.closed[i]]
                undo(world, chain, work)
        return accepted

    @compiled()
    def ascend(order, step, world, evidence, prior, means, chain, work, kind, tie):  # pragma: no cover
        """Move P(closed) of each barrier towards that which the others at their means imply; return the largest gap."""
        scratch = Scratch(np.empty(actions), np.empty(actions), np.empty(actions))
        largest = 0.0
        for i in order:
            old, old_passing = means[i], chain.passing[i]
            gain = closing_prior(means, i, prior)
            work.changed[0] = i
            for closed in range(2):
                chain.passing[i] = world.passing[i, closed]
                of_choices, of_transitions = change(1, world, evidence, chain, work, kind, tie, scratch)
                gain += (2 * closed - 1) * (of_choices + of_transitions)
                chain.passing[i] = old_passing
                undo(world, chain, work)
            implied = 1 / (1 + np.exp(min(-gain, 700.0)))
            largest = max(largest, abs(implied - old))
            means[i] = old + step * (implied - old)
            chain.passing[i] = (1 - means[i]) * world.passing[i, 0] + means[i] * world.passing[i, 1]
            of_choices, of_transitions = change(1, world, evidence, chain, work, kind, tie, scratch)
            chain.totals[0] += of_choices
            chain.totals[1] += of_transitions
        return largest

    return ChainKernels(refresh, sweep, ascend)
