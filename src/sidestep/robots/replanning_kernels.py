"""The compiled loops of `sidestep.robots.planners`, which explains the algorithm."""

from heapq import heappop, heappush

import numpy as np

from sidestep.tabular.solvers.native import compiled, part


@compiled()
def executed_length(environment, belief, start):  # pragma: no cover
    """Return the length of the path that a robot executes; its belief is updated after each bump.

    Args:
        environment: A `GridEnvironment`.
        belief: A `BeliefState`; its arrays are changed.
        start: The start state.
    """
    required = environment.required
    state, length, moves_since_bump = start, 0.0, 0
    stale = np.zeros(len(belief.success), np.bool_)
    while state != belief.goal:
        action = _next_action(belief, required, state)
        # a robot that moves on for so long without a bump never arrives
        if action < 0 or moves_since_bump > len(stale):
            return np.inf
        length += environment.lengths[action]
        moves_since_bump += 1
        hit = required[state, action]
        hit = hit[environment.obstacles[hit]]
        for cell in hit:
            block_and_repair(belief, required, cell, stale)
        if len(hit):
            moves_since_bump = 0
        else:
            state = required[state, action, 0]
    return length


@part()
def _next_action(belief, required, state):  # pragma: no cover
    """Return the first of the best actions, as in an optimal plan (`HardMax`) or a policy; −1 if none succeeds."""
    success = belief.success[state]
    if not len(belief.values):
        return np.argmax(success) if success.max() > 0 else -1
    # as in plans: by advantages, and what their rounding cannot tell apart is a tie
    most, least = np.full(len(success), -np.inf), -np.inf
    value = belief.values[state]
    if value > -np.inf:
        for a in np.flatnonzero(success > 0):
            after, reward, move = belief.values[required[state, a, 0]], belief.reward[state, a], success[a]
            if after > -np.inf:
                advantage = reward + belief.discount * move * (after - value) - (1 - belief.discount) * value
                summed = abs(reward) + belief.discount * move * (abs(after) + abs(value))
                error = belief.rounding * (summed + (1 - belief.discount) * abs(value))
                most[a] = advantage + error
                least = max(least, advantage - error)
    return np.argmax(most >= least) if least > -np.inf else -1


@part()
def _backup(belief, required, state, stale):  # pragma: no cover
    """Return the best value of a state by one action, repeated until it succeeds, that leads to no stale state."""
    best = -np.inf
    for a in range(belief.reward.shape[1]):
        move = belief.discount * belief.success[state, a]
        after = required[state, a, 0]
        if move > 0 and not stale[after]:
            best = max(best, (belief.reward[state, a] + move * belief.values[after]) / (1 - belief.discount + move))
    return best


@part()
def block_and_repair(belief, required, cell, stale):  # pragma: no cover
    """Block a cell and repair the values, if any; `stale` is False everywhere, before and after.

    Args:
        belief: A `BeliefState`; its arrays are changed.
        required: The cells that must be free for each move.
        cell: The blocked cell.
        stale: Working memory, one entry per state.
    """
    queue = [(0.0, 0) for _ in range(0)]
    for state in required[cell, :, 0]:
        if state < len(stale):
            for a in range(belief.success.shape[1]):
                if cell in required[state, a]:
                    belief.success[state, a] = 0.0
            if len(belief.values):
                heappush(queue, (-belief.values[state], state))
    unsupported = [0 for _ in range(0)]
    while queue:
        _, state = heappop(queue)
        value = belief.values[state]
        limit = value - belief.tolerance * abs(value)
        if stale[state] or state == belief.goal or _backup(belief, required, state, stale) >= limit:
            continue
        stale[state] = True
        unsupported.append(state)
        for neighbor in required[state, :, 0]:
            if neighbor < len(stale) and not stale[neighbor] and belief.values[neighbor] < value:
                heappush(queue, (-belief.values[neighbor], neighbor))
    for state in unsupported:
        belief.values[state] = _backup(belief, required, state, stale)
        heappush(queue, (-belief.values[state], state))
    while queue:
        _, state = heappop(queue)
        if not stale[state]:
            continue
        stale[state] = False
        for neighbor in required[state, :, 0]:
            if neighbor < len(stale) and stale[neighbor]:
                value = _backup(belief, required, neighbor, stale)
                if value > belief.values[neighbor]:
                    belief.values[neighbor] = value
                    heappush(queue, (-value, neighbor))
