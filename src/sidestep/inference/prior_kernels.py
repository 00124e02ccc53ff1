"""The prior of barriers and proposals of a Markov chain over them, as native code (numba).

A proposal and its reverse are equally probable, so a chain that accepts it with probability min(1, p(z′)/p(z)) has the
distribution p (Metropolis et al. 1953). `chain_kernels` accepts by the likelihood as well.
"""

from typing import NamedTuple

import numpy as np

from sidestep.tabular.solvers.native import compiled, part

_FAST = {"contract", "reassoc", "nsz", "arcp"}
MAX_CHANGED = 8
"""The most barriers that a proposal changes."""


class MRFTerms(NamedTuple):
    """The prior of the barriers as native code reads it (see `mrf.BinaryMRF`).

    Attributes:
        field: The log-odds of each barrier by itself.
        weights: Of lines, pairs, blocks and isolated cells.
        rows, columns: Of the grid; 0 where barriers are no cells.
    """

    field: np.ndarray
    weights: np.ndarray
    rows: int
    columns: int


@part()
def _at(closed, row, column, rows, columns):  # pragma: no cover
    """Return whether a cell is closed; cells outside the map are open."""
    if row < 0 or row >= rows or column < 0 or column >= columns:
        return 0
    return closed[row * columns + column]


@part(fastmath=_FAST)
def _shape_terms(closed, row, column, rows, columns, weights):  # pragma: no cover
    """Return the terms of log p(z) that depend on a cell beside its neighbors: lines, pairs, blocks, isolated.

    Of independent cells with P(closed) in `closed`, these are means, as each term is a product of different cells.
    """
    total = 0.0
    for k in range(5):
        r, c = row + (k == 1) - (k == 2), column + (k == 3) - (k == 4)
        here = _at(closed, r, c, rows, columns)
        if here > 0:
            left, right = _at(closed, r, c - 1, rows, columns), _at(closed, r, c + 1, rows, columns)
            up, down = _at(closed, r - 1, c, rows, columns), _at(closed, r + 1, c, rows, columns)
            total += weights[0] * here * (1 - (1 - left * right) * (1 - up * down))
            total += weights[3] * here * (1 - left) * (1 - right) * (1 - up) * (1 - down)
            if k == 0:
                total += weights[1] * here * (left + right + up + down)
    for i in range(2):
        for j in range(2):
            r, c = row - i, column - j
            upper = _at(closed, r, c, rows, columns) * _at(closed, r, c + 1, rows, columns)
            if upper > 0:
                lower = _at(closed, r + 1, c, rows, columns) * _at(closed, r + 1, c + 1, rows, columns)
                total += weights[2] * upper * lower
    return total


@compiled(fastmath=_FAST)
def flip_prior(closed, i, prior):  # pragma: no cover
    """Flip a barrier; return the change of log p(z)."""
    sign = 1 - 2 * closed[i]
    change = sign * prior.field[i]
    if prior.rows > 0:
        row, column = i // prior.columns, i % prior.columns
        change -= _shape_terms(closed, row, column, prior.rows, prior.columns, prior.weights)
        closed[i] = 1 - closed[i]
        change += _shape_terms(closed, row, column, prior.rows, prior.columns, prior.weights)
    else:
        closed[i] = 1 - closed[i]
    return change


@part(fastmath=_FAST)
def closing_prior(means, i, prior):  # pragma: no cover
    """Return the mean change of log p(z) from a barrier being open to closed; the others have P(closed) in `means`."""
    change = prior.field[i]
    if prior.rows > 0:
        row, column, old = i // prior.columns, i % prior.columns, means[i]
        means[i] = 1.0
        change += _shape_terms(means, row, column, prior.rows, prior.columns, prior.weights)
        means[i] = 0.0
        change -= _shape_terms(means, row, column, prior.rows, prior.columns, prior.weights)
        means[i] = old
    return change


@part()
def propose(rng, free, is_free, closed, prior, kinds, changed):  # pragma: no cover
    """Fill in the barriers of a proposal; return their number, 0 where the proposal is no change.

    A proposal and its reverse are equally probable. `kinds` are the cumulative probabilities of a flip and of a move;
    where there is no grid, all but moves are flips.
    """
    kind = rng.random()
    i = free[int(rng.random() * len(free))]
    on_grid, moves = prior.rows > 0, kinds[0] <= kind < kinds[1]
    if kind < kinds[0] or not (on_grid or moves):
        changed[0] = i
        return 1
    if not on_grid:
        j = free[int(rng.random() * len(free))]
        if closed[i] == closed[j]:
            return 0
        changed[0], changed[1] = i, j
        return 2
    row, column = i // prior.columns, i % prior.columns
    if moves:
        way = int(rng.random() * 8)
        way += way >= 4
        r, c = row + way // 3 - 1, column + way % 3 - 1
        if r < 0 or r >= prior.rows or c < 0 or c >= prior.columns:
            return 0
        j = r * prior.columns + c
        if not is_free[j] or closed[i] == closed[j]:
            return 0
        changed[0], changed[1] = i, j
        return 2
    length, down = 2 + int(rng.random() * (MAX_CHANGED - 2)), rng.random() < 0.5
    for step in range(length):
        r, c = row + step * down, column + step * (not down)
        if r >= prior.rows or c >= prior.columns:
            return 0
        j = r * prior.columns + c
        if not is_free[j] or closed[j] != closed[i]:
            return 0
        changed[step] = j
    return length


@compiled()
def sweep_prior(rng, sweeps, free, is_free, prior, kinds, closed, changed, samples):  # pragma: no cover
    """Make sweeps of a chain with the prior's distribution; fill in the map after each."""
    for number in range(sweeps):
        for _ in range(len(free)):
            count = propose(rng, free, is_free, closed, prior, kinds, changed)
            gain = 0.0
            for n in range(count):
                gain += flip_prior(closed, changed[n], prior)
            if np.log(rng.random()) > gain:
                for n in range(count):
                    closed[changed[n]] = 1 - closed[changed[n]]
        samples[number] = closed


@compiled()
def ascend_prior(order, step, prior, means):  # pragma: no cover
    """Move P(closed) of each barrier towards what the others imply, by the prior alone; return the largest gap."""
    largest = 0.0
    for i in order:
        old = means[i]
        implied = 1 / (1 + np.exp(min(-closing_prior(means, i, prior), 700.0)))
        largest = max(largest, abs(implied - old))
        means[i] = old + step * (implied - old)
    return largest
