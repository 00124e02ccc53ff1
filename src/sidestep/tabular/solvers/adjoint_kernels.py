"""The sweeps that solve the adjoint equation λ = g + Wᵀλ by pushing residuals, as native code (numba).

A *push* at a state with residual r adds r to its λ and r times the state's row of W to the residuals of its successors
(the push operation of Andersen, Chung & Lang, *Local graph partitioning using PageRank vectors*, 2006; on the values'
side, prioritized sweeping of Moore & Atkeson, 1993). It differs in three ways:

1. States come in a fixed order, the farthest first, so that what a state receives is mostly there before its push.
2. Only residuals above a threshold are pushed, and it falls from sweep to sweep (see `adjoint`): small ones add up
   first. States that cannot influence what is asked for are never touched.
3. Self-loops are divided out, as for the values (see `base`).

The row of a state is computed when it is first needed. With λ known, the gradient by everything that the values depend
on is summed state by state.
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from sidestep.tabular.solvers import native
from sidestep.tabular.solvers.value_kernels import Scratch, backed_up


class AdjointProblem(NamedTuple):
    """What the adjoint is of; states have their own numbers.

    Attributes:
        backup: The backup.
        exact: Whether the gradient is the backup's own, or that of the policy held fixed.
        values: V; −∞ in states that have no part in a gradient.
        order: The states, nearest first; `position` is its inverse.
    """

    backup: native.NativeBackup
    exact: bool
    values: np.ndarray
    order: np.ndarray
    position: np.ndarray


class AdjointState(NamedTuple):
    """λ so far, and the rows of W that were needed for it.

    By position: `row`, the number of the state's row, −1 as long as it has none; `adjoint` and `residual`, λ and
    g + Wᵀλ − λ. By row, close together in memory:

    Attributes:
        weights: w(a), the gradient of the value by the action values.
        beta: The gradient of the value by β.
        successors: The positions of the states that it leads to.
        jacobian: The entries of W for them.
        exit_weight: Σ w l.
        divisor: What the state's own adjoint equation is divided by.
    """

    row: np.ndarray
    adjoint: np.ndarray
    residual: np.ndarray
    weights: np.ndarray
    beta: np.ndarray
    successors: np.ndarray
    jacobian: np.ndarray
    exit_weight: np.ndarray
    divisor: np.ndarray


class WeightScratch(NamedTuple):
    """Memory for a state's action values, the weights of the gradient, and the policy; a tuple, as `Scratch` is.

    It is filled by functions that return only at their end, for the same reason.
    """

    action_values: np.ndarray
    weights: np.ndarray
    policy: np.ndarray


class AdjointKernels(NamedTuple):
    """The native code for one number of actions, of outcomes, and of outcomes that leave a state."""

    fill_rows: native.NativeFunction
    push: native.NativeFunction
    omission_cost: native.NativeFunction
    vjp_of_process: native.NativeFunction


@native.inlined()
def differentiate_backup(backup, exact, count, scratch):  # pragma: no cover
    """Fill in the weights of the gradient and the policy by action values; return the gradient by β.

    Action values are −∞ for actions that are never taken; `count` is the number of available ones.
    """
    kind, beta, tie, actions = backup.kind, backup.beta, backup.tie, len(scratch.action_values)
    best = scratch.action_values[0]
    for a in range(1, actions):
        best = max(best, scratch.action_values[a])
    total = 0.0 * best
    for a in range(actions):
        difference = scratch.action_values[a] - best
        scratch.policy[a] = (
            (difference >= -tie * abs(best)) * 1.0 if kind == native.HARD_MAX else np.exp(beta * difference)
        )
        total += scratch.policy[a]
    average = 0.0 * best
    for a in range(actions):
        scratch.policy[a] /= total
        if scratch.policy[a] > 0:
            average += scratch.policy[a] * (scratch.action_values[a] - best)
    variance = 0.0 * best
    for a in range(actions):
        probability = scratch.policy[a]
        scratch.weights[a] = probability
        if probability > 0:
            difference = scratch.action_values[a] - best - average
            variance += probability * difference * difference
            if kind == native.BOLTZMANN and exact:
                scratch.weights[a] = probability * (1 + beta * difference)
    by_beta = 0.0 * best
    if exact and kind == native.BOLTZMANN:
        by_beta = variance
    elif exact and kind != native.HARD_MAX:
        by_beta = (average - np.log(total / (count if kind == native.MELLOWMAX else 1)) / beta) / beta
    return by_beta


@native.inlined()
def available_count(available, state, actions):  # pragma: no cover
    """Return the number of actions that are available in a state."""
    count = 0
    for a in range(actions):
        count += available[state if available.shape[0] > 1 else 0, a if available.shape[1] > 1 else 0]
    return count


@native.inlined()
def _expected_value(process, values, state, a, outcomes):  # pragma: no cover
    """Return the expected value after an action, summed as in `action_values`; −∞ if it may lead to such a state."""
    here = values[state]
    expected = here
    for k in range(outcomes):
        after = process.successors[state, a, k]
        if after != state and process.probabilities[state, a, k] > 0:
            expected += process.probabilities[state, a, k] * (values[after] - here)
    return expected


@native.inlined()
def _action_value(process, values, state, a, outcomes):  # pragma: no cover
    """Return Q(s, a), −∞ for an action that is not available."""
    available = process.available
    if not available[state if available.shape[0] > 1 else 0, a if available.shape[1] > 1 else 0]:
        return -np.inf
    reward = process.reward[state if process.reward.shape[0] > 1 else 0, a if process.reward.shape[1] > 1 else 0]
    return reward + process.discount * _expected_value(process, values, state, a, outcomes)


@native.inlined()
def _fill_row(i, row, actions, outcomes, width, process, problem, work, scratch):  # pragma: no cover
    """Fill in the row of the state at position i; zeros if it is terminal or cannot reach a terminal state."""
    state = problem.order[i]
    is_live = problem.values[state] > -np.inf and not process.terminal[state]
    for a in range(actions):
        action_value = _action_value(process, problem.values, state, a, outcomes) if is_live else 0.0
        scratch.action_values[a] = action_value
    count = available_count(process.available, state, actions)
    by_beta = differentiate_backup(problem.backup, problem.exact, count, scratch)
    exit_weight, policy_exit = 0.0 * process.discount, 0.0 * process.discount
    for a in range(actions):
        weight, action_exit, m = scratch.weights[a] if is_live else 0.0, 1 - process.discount, 0
        work.weights[row, a] = weight
        for k in range(outcomes):
            after = process.successors[state, a, k]
            if after != state:
                move = process.discount * process.probabilities[state, a, k]
                work.successors[row, a, m] = problem.position[after]
                work.jacobian[row, a, m] = weight * move
                action_exit += move
                m += 1
        for padding in range(m, width):
            work.successors[row, a, padding] = i
            work.jacobian[row, a, padding] = 0
        exit_weight += weight * action_exit
        policy_exit += scratch.policy[a] * action_exit
    divisor = max(exit_weight, policy_exit)
    work.beta[row] = by_beta if is_live else 0.0
    work.exit_weight[row] = exit_weight if is_live else 1.0
    work.divisor[row] = divisor if is_live and divisor > 0 else 1.0
    work.row[i] = row


@cache
def kernels_for(actions: int, outcomes: int, width: int) -> AdjointKernels:
    """Return the native code for these numbers; as constants they make it twice as fast."""

    @native.compiled()
    def fill_rows(begin, end, positions, process, problem, work):  # pragma: no cover
        """Fill in a range of rows, of the states at `positions`."""
        dtype = problem.values.dtype
        scratch = WeightScratch(np.empty(actions, dtype), np.empty(actions, dtype), np.empty(actions, dtype))
        for row in range(begin, end):
            _fill_row(positions[row], row, actions, outcomes, width, process, problem, work, scratch)

    @native.compiled()
    def push(threshold, warm, filled, process, problem, work):  # pragma: no cover
        """Push the residuals above a threshold, the farthest first; or (`warm`) the first λ.

        Returns:
            The number of pushes, the sum of the absolute residuals that remain, and the number of rows filled in.
        """
        dtype = problem.values.dtype
        scratch = WeightScratch(np.empty(actions, dtype), np.empty(actions, dtype), np.empty(actions, dtype))
        pushes, remaining = 0, 0.0 * threshold
        for i in range(len(work.residual) - 1, -1, -1):
            missing = work.adjoint[i] if warm else work.residual[i]
            if not abs(missing) > threshold:
                if warm:
                    work.adjoint[i] = 0
                remaining += abs(missing)
                continue
            pushes += 1
            if work.row[i] < 0:
                _fill_row(i, filled, actions, outcomes, width, process, problem, work, scratch)
                filled += 1
            row, amount = work.row[i], missing
            if not warm:
                amount = missing / work.divisor[row]
                work.adjoint[i] += amount
            work.residual[i] -= amount * work.exit_weight[row]
            for a in range(actions):
                for m in range(width):
                    work.residual[work.successors[row, a, m]] += amount * work.jacobian[row, a, m]
        return pushes, remaining, filled

    @native.compiled()
    def omission_cost(process, problem, adjoint, region):  # pragma: no cover
        """Return Σ |λ (B(Q) − V)| over the states outside the region."""
        values = problem.values
        advantages = np.empty(actions, values.dtype)
        scratch = Scratch(advantages, np.ones(actions, values.dtype), advantages)
        cost = 0.0 * process.discount
        for i in range(len(adjoint)):
            state = problem.order[i]
            is_live = not process.terminal[state] and values[state] > -np.inf
            if region[state] or adjoint[i] == 0 or not is_live:
                continue
            for a in range(actions):
                scratch.advantages[a] = _action_value(process, values, state, a, outcomes) - values[state]
            gain, _ = backed_up(problem.backup, available_count(process.available, state, actions), scratch)
            cost += abs(adjoint[i] * gain)
        return cost

    @native.compiled()
    def vjp_of_process(begin, end, process, problem, solution, row, weights, beta, adjoint, by):  # pragma: no cover
        """Fill in λᵀ ∂F/∂φ for a range of positions, and λ with the states' own numbers.

        `solution` is λ by position; `row`, `weights` and `beta` are as in `AdjointState`. Gradients by numbers that
        several states have in common are added to.
        """
        values = problem.values
        for i in range(begin, end):
            weight, own, state = solution[i], row[i], problem.order[i]
            adjoint[state] = weight
            by.probabilities[state] = 0
            if weight == 0:
                continue
            if process.terminal[state]:
                by.terminal_reward[state if len(by.terminal_reward) > 1 else 0] += weight
                continue
            by.beta[()] += weight * beta[own]
            for a in range(actions):
                by_action = weight * weights[own, a]
                if by_action == 0:
                    for k in range(outcomes):
                        by.probabilities[state, a, k] = 0
                    continue
                by.reward[state if by.reward.shape[0] > 1 else 0, a if by.reward.shape[1] > 1 else 0] += by_action
                by.discount[()] += by_action * _expected_value(process, values, state, a, outcomes)
                for k in range(outcomes):
                    after = process.successors[state, a, k]
                    # an impossible outcome may lead to a state of value −∞
                    if after != state and values[after] > -np.inf:
                        difference = values[after] - values[state]
                        by.probabilities[state, a, k] += by_action * process.discount * difference

    return AdjointKernels(fill_rows, push, omission_cost, vjp_of_process)
