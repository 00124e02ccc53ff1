"""The adjoint in the order of distance, farthest states first, as machine code (numba).

λ = g + Wᵀλ (see `process`) is solved by passing on what is missing: from the farthest state inwards, a state with
residual r adds r to its λ (self-loops divided out) and r's shares to the residuals of the states it leads to. States
that nobody who is looked at can influence are never touched. Small residuals wait, so that they add up before they are
passed on: the threshold falls from sweep to sweep (see `inwards`).

A state's shares are worked out when it is first needed. With λ known, the gradient by everything that the values depend
on is summed state by state.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from sidestep.tabular.solvers.compiled import compiled, inlined
from sidestep.tabular.solvers.given import Given
from sidestep.tabular.solvers.sweeping import BOLTZMANN, HARD_MAX, MELLOWMAX, Scratch, Valuing, backed_up


class Setting(NamedTuple):
    """What the adjoint is of; the states have their own numbers.

    - `exact`: whether the gradient is the backup's own, or that of the policy held fixed.
    - `values`: V; below `reached` they mean that no terminal state can be reached.
    - `order`, `position`: which state comes when, and when a state comes.
    """

    given: Given
    valuing: Valuing
    exact: bool
    values: np.ndarray
    reached: np.floating
    order: np.ndarray
    position: np.ndarray


class Shares(NamedTuple):
    """How the value of a state depends on those of others, and λ so far; states by position, filled in when needed.

    - `known`: whether the state's entries have been filled in.
    - `weights`: w(a), the gradient of the value by the action values; `beta`: its gradient by β.
    - `successors`, `shares`: the states that it leads to, and the entries of W for them.
    - `leaving`, `divisor`: Σ w l, and what the state's own adjoint equation is divided by.
    - `adjoint`, `residual`: λ, and g + Wᵀλ − λ.
    """

    known: np.ndarray
    weights: np.ndarray
    beta: np.ndarray
    successors: np.ndarray
    shares: np.ndarray
    leaving: np.ndarray
    divisor: np.ndarray
    adjoint: np.ndarray
    residual: np.ndarray


class HostGradients(NamedTuple):
    """The gradients to write into; fields as in `Gradients`."""

    probabilities: np.ndarray
    reward: np.ndarray
    final_reward: np.ndarray
    discount: np.ndarray
    beta: np.ndarray


class Passing(NamedTuple):
    """The machine code for one number of actions, of outcomes, and of outcomes that leave a state."""

    fill_in: Any
    pass_on: Any
    left_out: Any
    pull_back: Any


@inlined()
def weigh(valuing, exact, q, weights, policy):  # pragma: no cover
    """Fills in the weights of the gradient and the policy at action values q; returns the gradient by β."""
    kind, beta, tie = valuing.kind, valuing.beta, valuing.tie
    best = q[0]
    for a in range(1, len(q)):
        best = max(best, q[a])
    total = 0.0 * best
    for a in range(len(q)):
        behind = q[a] - best
        policy[a] = (behind >= -tie * abs(best)) * 1.0 if kind == HARD_MAX else np.exp(beta * behind)
        total += policy[a]
    average = 0.0 * best
    for a in range(len(q)):
        policy[a] /= total
        average += policy[a] * (q[a] - best)
    variance = 0.0 * best
    for a in range(len(q)):
        behind = q[a] - best - average
        # in this order, because an action that is never taken may be worth all but −∞
        variance += policy[a] * behind * behind
        weights[a] = policy[a] * (1 + beta * behind) if kind == BOLTZMANN and exact else policy[a]
    if not exact or kind == HARD_MAX:
        return 0.0 * best
    if kind == BOLTZMANN:
        return variance
    actions = len(q) if kind == MELLOWMAX else 1
    return (average - np.log(total / actions) / beta) / beta


@inlined()
def _expected(setting, state, a, outcomes):  # pragma: no cover
    """The expected value after an action, summed as in `DecisionProcess.action_values`."""
    given, values = setting.given, setting.values
    here = values[state]
    expected = here
    for k in range(outcomes):
        after = given.successors[state, a, k]
        if after != state:
            expected += given.probabilities[state, a, k] * (values[after] - here)
    return expected


@inlined()
def _action_value(setting, state, a, outcomes):  # pragma: no cover
    """Q(s, a)."""
    given = setting.given
    reward = given.reward[state if given.reward.shape[0] > 1 else 0, a if given.reward.shape[1] > 1 else 0]
    return reward + given.discount * _expected(setting, state, a, outcomes)


@inlined()
def _fill_in(i, actions, outcomes, setting, shares, q, policy):  # pragma: no cover
    """The entries of the state at position i. Of a state without values to speak of, nothing is passed on."""
    given, state = setting.given, setting.order[i]
    shares.known[i] = True
    shares.leaving[i] = shares.divisor[i] = 1
    shares.shares[i] = 0
    shares.successors[i] = i
    shares.weights[i] = 0
    shares.beta[i] = 0
    if given.terminal[state] or not setting.values[state] > setting.reached:
        return
    for a in range(actions):
        q[a] = _action_value(setting, state, a, outcomes)
    shares.beta[i] = weigh(setting.valuing, setting.exact, q, shares.weights[i], policy)
    leaving, policy_leaving = 0.0 * given.discount, 0.0 * given.discount
    for a in range(actions):
        left, m = 1 - given.discount, 0
        for k in range(outcomes):
            after = given.successors[state, a, k]
            if after != state:
                move = given.discount * given.probabilities[state, a, k]
                shares.successors[i, a, m] = setting.position[after]
                shares.shares[i, a, m] = shares.weights[i, a] * move
                left += move
                m += 1
        leaving += shares.weights[i, a] * left
        policy_leaving += policy[a] * left
    divisor = max(leaving, policy_leaving)
    shares.leaving[i] = leaving
    shares.divisor[i] = divisor if divisor > 0 else 1.0


@cache
def passing_for(actions: int, outcomes: int, width: int) -> Passing:
    """The machine code for that many; as constants they make it twice as fast."""

    @compiled()
    def fill_in(begin, end, threshold, setting, shares):  # pragma: no cover
        """Fills in the entries of states that are sure to be needed: those whose first λ is above a threshold."""
        q, policy = np.empty(actions, setting.values.dtype), np.empty(actions, setting.values.dtype)
        for i in range(begin, end):
            if abs(shares.adjoint[i]) > threshold:
                _fill_in(i, actions, outcomes, setting, shares, q, policy)

    @compiled()
    def pass_on(threshold, warm, setting, shares):  # pragma: no cover
        """Passes on the residuals above a threshold, the farthest state first; or (`warm`) what a first λ amounts to.

        Returns how many states had something to pass on, and the sum of all residuals' sizes that were left alone.
        """
        q, policy = np.empty(actions, setting.values.dtype), np.empty(actions, setting.values.dtype)
        at_work, left_alone = 0, 0.0 * threshold
        for i in range(len(shares.residual) - 1, -1, -1):
            missing = shares.adjoint[i] if warm else shares.residual[i]
            if not abs(missing) > threshold:
                if warm:
                    shares.adjoint[i] = 0
                left_alone += abs(missing)
                continue
            at_work += 1
            if not shares.known[i]:
                _fill_in(i, actions, outcomes, setting, shares, q, policy)
            amount = missing
            if not warm:
                amount = missing / shares.divisor[i]
                shares.adjoint[i] += amount
            shares.residual[i] -= amount * shares.leaving[i]
            for a in range(actions):
                for m in range(width):
                    shares.residual[shares.successors[i, a, m]] += amount * shares.shares[i, a, m]
        return at_work, left_alone

    @compiled()
    def left_out(setting, adjoint, region):  # pragma: no cover
        """Σ |λ (B(Q) − V)| over the states outside the region."""
        given, values = setting.given, setting.values
        advantage, leaving = np.empty(actions, values.dtype), np.ones(actions, values.dtype)
        cost = 0.0 * given.discount
        for i in range(len(adjoint)):
            state = setting.order[i]
            if region[state] or adjoint[i] == 0 or given.terminal[state] or not values[state] > setting.reached:
                continue
            for a in range(actions):
                advantage[a] = _action_value(setting, state, a, outcomes) - values[state]
            gain, _ = backed_up(setting.valuing, Scratch(leaving, leaving, advantage))
            cost += abs(adjoint[i] * gain)
        return cost

    @compiled()
    def pull_back(begin, end, setting, found, weights, beta, adjoint, by):  # pragma: no cover
        """Fills in the gradients `by` φ with λᵀ ∂F/∂φ, and λ with the states' own numbers, for a range of positions.

        λ is what was `found`, `weights` and `beta` are as in `Shares`. Gradients by numbers that states share are added
        to.
        """
        given, values = setting.given, setting.values
        for i in range(begin, end):
            weight = found[i]
            state = setting.order[i]
            adjoint[state] = weight
            by.probabilities[state] = 0
            if weight == 0:
                continue
            if given.terminal[state]:
                by.final_reward[state if len(by.final_reward) > 1 else 0] += weight
                continue
            by.beta[()] += weight * beta[i]
            for a in range(actions):
                share = weight * weights[i, a]
                by.reward[state if by.reward.shape[0] > 1 else 0, a if by.reward.shape[1] > 1 else 0] += share
                by.discount[()] += share * _expected(setting, state, a, outcomes)
                for k in range(outcomes):
                    after = given.successors[state, a, k]
                    if after != state:
                        gained = values[after] - values[state]
                        by.probabilities[state, a, k] += share * given.discount * gained

    return Passing(fill_in, pass_on, left_out, pull_back)
