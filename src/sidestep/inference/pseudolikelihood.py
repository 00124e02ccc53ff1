"""The shape of maps: weights of a `BinaryMRF` by maximum pseudo-likelihood over a bank of true maps.

The normalizer Z of a Markov random field is a sum over all maps, so the likelihood of its weights is out of reach. The
pseudo-likelihood (Besag 1975) is the product over cells of the probability of each given all others,

    log PL(w) = Σ_i log P(z_i | z_−i),    P(z_i = 1 | z_−i) = σ(w · Δ_i),

where Δ_i is how much closing cell i changes the features: the number of closed cells, lines, pairs, blocks and isolated
cells. This is a logistic regression of z_i on Δ_i over all cells of all maps (Strauss & Ikeda 1990), and concave. Here
it has a normal prior N(0, σ²) of each weight, so that weights stay finite where maps never show a feature.

References:
    J. Besag (1975). Statistical analysis of non-lattice data. The Statistician 24(3).
    D. Strauss and M. Ikeda (1990). Pseudolikelihood estimation for social networks. Journal of the American
    Statistical Association 85(409).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep._arguments import to_integers
from sidestep._repr import short_repr
from sidestep.errors import check, check_positive, describe, to_list, to_number
from sidestep.inference.mrf import SHAPE_TERMS, BinaryMRF
from sidestep.tabular.grid import STEPS, Cell, Grid

_TOLERANCE = 1e-8


@short_repr()
@dataclass(frozen=True, eq=False)
class MRFFit:
    """Weights of a `BinaryMRF` that were fitted to maps.

    Attributes:
        field: η, the log-odds of a cell where no shape term counts: one number for all maps, or one for each.
        lines, pairs, blocks, isolated: The weights of the shape terms in nats; 0 for those that were left out.
        cells: The number of cells that count.
        log_pseudolikelihood: The mean of log P(z_i | z_−i) over them, in nats.
    """

    field: Float[np.ndarray, " fields"]
    lines: float
    pairs: float
    blocks: float
    isolated: float
    cells: int
    log_pseudolikelihood: float

    def prior(self, shape: tuple[int, int], field: float | None = None) -> BinaryMRF:
        """Return the field with these weights over the cells of a grid.

        Args:
            shape: The rows and columns.
            field: Another η; None for the mean of those that were fitted.

        Raises:
            InputError: For a shape that is no pair of numbers above 0, and a field that is not finite.
        """
        own = float(self.field.mean()) if field is None else to_number(field, "field")
        rows, columns = to_integers(shape, "shape", (2,), least=1).tolist()
        field_of_cells = np.full(rows * columns, own)
        return BinaryMRF(field_of_cells, (rows, columns), self.lines, self.pairs, self.blocks, self.isolated)


def fit_mrf(
    maps: Sequence[Grid],
    terms: Sequence[str] = SHAPE_TERMS,
    *,
    separate_fields: bool = False,
    standard_deviation: float = 10.0,
) -> MRFFit:
    """Fit the weights of a binary Markov random field to true maps by maximum pseudo-likelihood.

    Unknown cells count as open for their neighbors, as cells outside the map do, and not by themselves.

    Args:
        maps: The bank of true maps, each cell of which counts once.
        terms: The shape terms that are fitted, of `SHAPE_TERMS`.
        separate_fields: Whether each map has a density η of its own; the shape terms are always shared.
        standard_deviation: σ of the normal prior of each weight, in nats, above 0.

    Returns:
        The weights.

    Raises:
        InputError: For no maps, maps without both free and occupied cells, unknown terms, and a standard deviation that
            is not above 0.

    Example:
        >>> wall = np.zeros((6, 6), dtype=int)
        >>> wall[1:5, 2] = 1
        >>> fit = fit_mrf([Grid(wall)], terms=["lines"])
        >>> bool(fit.field[0] < 0 < fit.lines), fit.cells
        (True, 36)
    """
    grids = to_list(maps, Grid, "maps")
    check_positive(standard_deviation, "standard_deviation")
    known = isinstance(terms, list | tuple) and all(term in SHAPE_TERMS for term in terms)
    check(known, f"expected some of {', '.join(SHAPE_TERMS)}, found {describe(terms)}", field="terms")
    # equal cells count together: a row has the cell's map, whether it is closed, and the changes
    cells = np.concatenate([_cells(grid, index if separate_fields else 0, terms) for index, grid in enumerate(grids)])
    rows, counts = np.unique(cells, axis=0, return_counts=True)
    owner, closed = rows[:, 0], rows[:, 1] == 1
    check(closed.any() and not closed.all(), "expected free and occupied cells, found one kind", field="maps")
    fields = np.eye(len(grids) if separate_fields else 1)[owner]
    weights, mean = _logistic(np.hstack([fields, rows[:, 2:]]), closed, counts, standard_deviation)
    field, shape = np.split(weights, [fields.shape[1]])
    shared = dict.fromkeys(SHAPE_TERMS, 0.0) | dict(zip(terms, shape.tolist(), strict=True))
    return MRFFit(field, **shared, cells=len(cells), log_pseudolikelihood=mean)


def closing_changes(closed: Bool[np.ndarray, "rows columns"]) -> Int[np.ndarray, "rows columns 4"]:
    """Return how much closing each cell of a map, the others as they are, changes the `shape_counts`.

    Args:
        closed: Whether each cell is blocked; it makes no difference whether the cell itself is.

    Example:
        >>> closing_changes(np.array([[True, False, True]]))[0, 1].tolist()  # a line, two pairs, and two isolated less
        [1, 2, 0, -2]
    """
    rows, columns = closed.shape
    padded = np.pad(closed, 2)

    def at(place: np.ndarray) -> np.ndarray:
        """Return the cells that lie some rows and columns away from each cell."""
        return padded[2 + place[0] : 2 + place[0] + rows, 2 + place[1] : 2 + place[1] + columns]

    up, down, left, right = STEPS[:4]
    lines = ((at(left) & at(right)) | (at(up) & at(down))).astype(np.int64)
    pairs = np.sum([at(side) for side in STEPS[:4]], axis=0)
    isolated = np.where(pairs == 0, 1, 0)
    blocks = np.zeros_like(lines)
    for side in STEPS[:4]:
        # what closing a cell does to a closed neighbor
        beyond, turned = at(2 * side), np.array([side[1], -side[0]])
        one, other = at(side + turned), at(side - turned)
        lines += at(side) & beyond & ~(one & other)
        isolated -= at(side) & ~(beyond | one | other)
        blocks += at(side) & one & at(turned)
    return np.stack([lines, pairs, blocks, isolated], axis=-1)


def _cells(grid: Grid, owner: int, terms: Sequence[str]) -> Int[np.ndarray, "cells entries"]:
    """Return a row for each known cell of a map: a number, whether it is closed, and the changes by closing it."""
    closed, known = grid.known == Cell.OCCUPIED, grid.known != Cell.UNKNOWN
    changes = closing_changes(closed)[known][:, [SHAPE_TERMS.index(term) for term in terms]]
    return np.column_stack([np.full(len(changes), owner), closed[known], changes])


def _logistic(
    features: Float[np.ndarray, "rows weights"],
    closed: Bool[np.ndarray, " rows"],
    counts: Int[np.ndarray, " rows"],
    standard_deviation: float,
) -> tuple[Float[np.ndarray, " weights"], float]:
    """Return the weights of a logistic regression with a normal prior, and the mean log-likelihood of a cell."""
    from sklearn.linear_model import LogisticRegression

    model = LogisticRegression(C=standard_deviation**2, fit_intercept=False, solver="newton-cholesky", tol=_TOLERANCE)
    model.fit(features, closed, sample_weight=counts)
    logits = np.where(closed, 1, -1) * (features @ model.coef_[0])
    return model.coef_[0], float(-(counts * np.logaddexp(0, -logits)).sum() / counts.sum())
