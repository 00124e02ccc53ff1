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
from sidestep.tabular.solvers.value_kernels import BOLTZMANN, HARD_MAX, MELLOWMAX, Scratch, Valuing, backed_up


class Setting(NamedTuple):
    """What the adjoint is of; the states have their own numbers.

    - `exact`: whether the gradient is the backup's own, or that of the policy held fixed.
    - `values`: V; below `reached` they mean that no terminal state can be reached.
    - `order`, `position`: which state comes when, and when a state comes.
    """

    valuing: Valuing
    exact: bool
    values: np.ndarray
    reached: np.floating
    order: np.ndarray
    position: np.ndarray


class Shares(NamedTuple):
    """How the values of states depend on those of others, and λ so far.

    By position:

    - `row`: which of the rows below is the state's; −1 as long as it has none.
    - `adjoint`, `residual`: λ, and g + Wᵀλ − λ.

    Rows, one for each state that turned out to be needed, so that they lie close together in memory:

    - `weights`: w(a), the gradient of the value by the action values; `beta`: its gradient by β.
    - `successors`, `shares`: the positions of the states that it leads to, and the entries of W for them.
    - `leaving`, `divisor`: Σ w l, and what the state's own adjoint equation is divided by.
    """

    row: np.ndarray
    adjoint: np.ndarray
    residual: np.ndarray
    weights: np.ndarray
    beta: np.ndarray
    successors: np.ndarray
    shares: np.ndarray
    leaving: np.ndarray
    divisor: np.ndarray


class Weighing(NamedTuple):
    """Room for a state's action values, the weights of the gradient by them, and the policy.

    In a tuple, and filled by functions that return nowhere but at their end, for the reason that `Scratch` tells.
    """

    action_values: np.ndarray
    weights: np.ndarray
    policy: np.ndarray


class HostCotangents(NamedTuple):
    """The gradients to write into; fields as in `Cotangents`."""

    probabilities: np.ndarray
    reward: np.ndarray
    terminal_reward: np.ndarray
    discount: np.ndarray
    beta: np.ndarray


class Passing(NamedTuple):
    """The machine code for one number of actions, of outcomes, and of outcomes that leave a state."""

    fill_in: Any
    pass_on: Any
    left_out: Any
    vjp: Any


@inlined()
def weigh(valuing, exact, weighing):  # pragma: no cover
    """Fills in the weights of the gradient and the policy by action values; returns the gradient by β."""
    kind, beta, tie, actions = valuing.kind, valuing.beta, valuing.tie, len(weighing.action_values)
    best = weighing.action_values[0]
    for a in range(1, actions):
        best = max(best, weighing.action_values[a])
    total = 0.0 * best
    for a in range(actions):
        behind = weighing.action_values[a] - best
        weighing.policy[a] = (behind >= -tie * abs(best)) * 1.0 if kind == HARD_MAX else np.exp(beta * behind)
        total += weighing.policy[a]
    average = 0.0 * best
    for a in range(actions):
        weighing.policy[a] /= total
        average += weighing.policy[a] * (weighing.action_values[a] - best)
    variance = 0.0 * best
    for a in range(actions):
        behind, taken = weighing.action_values[a] - best - average, weighing.policy[a]
        # in this order, because an action that is never taken may be worth all but −∞
        variance += taken * behind * behind
        weighing.weights[a] = taken * (1 + beta * behind) if kind == BOLTZMANN and exact else taken
    by_beta = 0.0 * best
    if exact and kind == BOLTZMANN:
        by_beta = variance
    elif exact and kind != HARD_MAX:
        by_beta = (average - np.log(total / (actions if kind == MELLOWMAX else 1)) / beta) / beta
    return by_beta


@inlined()
def _expected(given, values, state, a, outcomes):  # pragma: no cover
    """The expected value after an action, summed as in `DecisionProcess.action_values`."""
    here = values[state]
    expected = here
    for k in range(outcomes):
        after = given.successors[state, a, k]
        if after != state:
            expected += given.probabilities[state, a, k] * (values[after] - here)
    return expected


@inlined()
def _action_value(given, values, state, a, outcomes):  # pragma: no cover
    """Q(s, a)."""
    reward = given.reward[state if given.reward.shape[0] > 1 else 0, a if given.reward.shape[1] > 1 else 0]
    return reward + given.discount * _expected(given, values, state, a, outcomes)


@inlined()
def _fill_in(i, row, actions, outcomes, width, given, setting, shares, weighing):  # pragma: no cover
    """Fills in the row of the state at position i. Of a state without values to speak of, the shares are 0."""
    state = setting.order[i]
    passes_on = setting.values[state] > setting.reached and not given.terminal[state]
    for a in range(actions):
        worth = _action_value(given, setting.values, state, a, outcomes) if passes_on else 0.0
        weighing.action_values[a] = worth
    by_beta = weigh(setting.valuing, setting.exact, weighing)
    leaving, policy_leaving = 0.0 * given.discount, 0.0 * given.discount
    for a in range(actions):
        weight, left, m = weighing.weights[a] if passes_on else 0.0, 1 - given.discount, 0
        shares.weights[row, a] = weight
        for k in range(outcomes):
            after = given.successors[state, a, k]
            if after != state:
                move = given.discount * given.probabilities[state, a, k]
                shares.successors[row, a, m] = setting.position[after]
                shares.shares[row, a, m] = weight * move
                left += move
                m += 1
        for padding in range(m, width):
            shares.successors[row, a, padding] = i
            shares.shares[row, a, padding] = 0
        leaving += weight * left
        policy_leaving += weighing.policy[a] * left
    divisor = max(leaving, policy_leaving)
    shares.beta[row] = by_beta if passes_on else 0.0
    shares.leaving[row] = leaving if passes_on else 1.0
    shares.divisor[row] = divisor if passes_on and divisor > 0 else 1.0
    shares.row[i] = row


@cache
def passing_for(actions: int, outcomes: int, width: int) -> Passing:
    """The machine code for that many; as constants they make it twice as fast."""

    @compiled()
    def fill_in(begin, end, which, given, setting, shares):  # pragma: no cover
        """Fills in a range of rows, for the states at the positions `which`."""
        dtype = setting.values.dtype
        weighing = Weighing(np.empty(actions, dtype), np.empty(actions, dtype), np.empty(actions, dtype))
        for row in range(begin, end):
            _fill_in(which[row], row, actions, outcomes, width, given, setting, shares, weighing)

    @compiled()
    def pass_on(threshold, warm, filled, given, setting, shares):  # pragma: no cover
        """Passes on the residuals above a threshold, the farthest state first; or (`warm`) what a first λ amounts to.

        Returns how many states had something to pass on, the sum of all residuals' sizes that were left alone, and how
        many rows are `filled` by now.
        """
        dtype = setting.values.dtype
        weighing = Weighing(np.empty(actions, dtype), np.empty(actions, dtype), np.empty(actions, dtype))
        at_work, left_alone = 0, 0.0 * threshold
        for i in range(len(shares.residual) - 1, -1, -1):
            missing = shares.adjoint[i] if warm else shares.residual[i]
            if not abs(missing) > threshold:
                if warm:
                    shares.adjoint[i] = 0
                left_alone += abs(missing)
                continue
            at_work += 1
            if shares.row[i] < 0:
                _fill_in(i, filled, actions, outcomes, width, given, setting, shares, weighing)
                filled += 1
            row, amount = shares.row[i], missing
            if not warm:
                amount = missing / shares.divisor[row]
                shares.adjoint[i] += amount
            shares.residual[i] -= amount * shares.leaving[row]
            for a in range(actions):
                for m in range(width):
                    shares.residual[shares.successors[row, a, m]] += amount * shares.shares[row, a, m]
        return at_work, left_alone, filled

    @compiled()
    def left_out(given, setting, adjoint, region):  # pragma: no cover
        """Σ |λ (B(Q) − V)| over the states outside the region."""
        values = setting.values
        advantage = np.empty(actions, values.dtype)
        scratch = Scratch(advantage, np.ones(actions, values.dtype), advantage)
        cost = 0.0 * given.discount
        for i in range(len(adjoint)):
            state = setting.order[i]
            if region[state] or adjoint[i] == 0 or given.terminal[state] or not values[state] > setting.reached:
                continue
            for a in range(actions):
                scratch.advantage[a] = _action_value(given, values, state, a, outcomes) - values[state]
            gain, _ = backed_up(setting.valuing, scratch)
            cost += abs(adjoint[i] * gain)
        return cost

    @compiled()
    def vjp(begin, end, given, setting, found, row, weights, beta, adjoint, by):  # pragma: no cover
        """Fills in the gradients `by` φ with λᵀ ∂F/∂φ, and λ with the states' own numbers, for a range of positions.

        λ is what was `found`; `row`, `weights` and `beta` are as in `Shares`. Gradients by numbers that states share
        are added to.
        """
        values = setting.values
        for i in range(begin, end):
            weight, own, state = found[i], row[i], setting.order[i]
            adjoint[state] = weight
            by.probabilities[state] = 0
            if weight == 0:
                continue
            if given.terminal[state]:
                by.terminal_reward[state if len(by.terminal_reward) > 1 else 0] += weight
                continue
            by.beta[()] += weight * beta[own]
            for a in range(actions):
                share = weight * weights[own, a]
                by.reward[state if by.reward.shape[0] > 1 else 0, a if by.reward.shape[1] > 1 else 0] += share
                by.discount[()] += share * _expected(given, values, state, a, outcomes)
                for k in range(outcomes):
                    after = given.successors[state, a, k]
                    if after != state:
                        gained = values[after] - values[state]
                        by.probabilities[state, a, k] += share * given.discount * gained

    return Passing(fill_in, pass_on, left_out, vjp)
