"""The compiled loops of `sidestep.robots.replanning`, which explains the algorithm."""

from heapq import heappop, heappush

import numpy as np

from sidestep.tabular.solvers.native import compiled


@compiled()
def length_by_policy(policy, order, environment, goal, start):  # pragma: no cover
    """Return the length of the executed path of a robot that takes actions by their order in each state."""
    state, length, moves_since_bump = start, 0.0, 0
    known_obstacles = np.zeros(len(environment.obstacles), np.bool_)
    while state != goal:
        action = -1
        for a in order[state]:
            if policy[state, a] > 0 and not known_obstacles[environment.required[state, a]].any():
                action = a
                break
        if action < 0 or moves_since_bump > len(policy):
            return np.inf
        length += environment.lengths[action]
        moves_since_bump += 1
        hit = _obstacles_hit(environment, state, action)
        known_obstacles[hit] = True
        if len(hit):
            moves_since_bump = 0
        else:
            state = environment.required[state, action, 0]
    return length


@compiled()
def length_by_replanning(environment, belief, start):  # pragma: no cover
    """Return the length of the executed path of a robot that replans after each bump; its belief is updated."""
    state, length, moves_since_bump = start, 0.0, 0
    stale = np.zeros(len(belief.values), np.bool_)
    while state != belief.goal:
        # below discount 1 states without a path have values too: a robot that moves on for so long never arrives
        if belief.values[state] == -np.inf or moves_since_bump > len(belief.values):
            return np.inf
        action = _best_action(belief, environment.required, state)
        if action < 0:
            return np.inf
        length += environment.lengths[action]
        moves_since_bump += 1
        hit = _obstacles_hit(environment, state, action)
        for cell in hit:
            block_and_repair(belief, environment.required, cell, stale)
        if len(hit):
            moves_since_bump = 0
        else:
            state = environment.required[state, action, 0]
    return length


@compiled()
def _obstacles_hit(environment, state, action):  # pragma: no cover
    """Return the obstacles that make an action fail; none if it succeeds."""
    required = environment.required[state, action]
    return required[environment.obstacles[required]]


@compiled()
def _best_action(belief, required, state):  # pragma: no cover
    """Return the first of the best actions, as in an optimal plan (`HardMax`); −1 if no action succeeds."""
    q = np.full(belief.reward.shape[1], -np.inf)
    value = belief.values[state]
    for a in range(len(q)):
        if belief.success[state, a] > 0:
            gain = belief.success[state, a] * (belief.values[required[state, a, 0]] - value)
            q[a] = belief.reward[state, a] + belief.discount * (value + gain)
    best = q.max()
    return np.argmax(q >= best - belief.tolerance * abs(best)) if best > -np.inf else -1


@compiled()
def _backup(belief, required, state, stale):  # pragma: no cover
    """Return the best value of a state by one action, repeated until it succeeds, that leads to no stale state."""
    best = -np.inf
    for a in range(belief.reward.shape[1]):
        move = belief.discount * belief.success[state, a]
        if move > 0 and not stale[required[state, a, 0]]:
            best = max(
                best,
                (belief.reward[state, a] + move * belief.values[required[state, a, 0]]) / (1 - belief.discount + move),
            )
    return best


@compiled()
def block_and_repair(belief, required, cell, stale):  # pragma: no cover
    """Block a cell and repair the values; `stale` is False everywhere, before and after."""
    queue = [(0.0, 0) for _ in range(0)]
    for state in required[cell, :, 0]:
        if state < len(stale):
            for a in range(belief.reward.shape[1]):
                if cell in required[state, a]:
                    belief.success[state, a] = 0.0
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
