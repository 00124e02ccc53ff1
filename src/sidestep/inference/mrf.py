"""A binary Markov random field: the prior of barriers that are open or closed.

With z(i) = 1 where barrier i is closed and 0 where it is open,

    log p(z) = Σ_i η_i z_i + s · lines + c · pairs + t · blocks + u · isolated − log Z,

where barriers that are the cells of a grid have four *shape terms*:

    lines       closed cells between two closed ones of their row or column
    pairs       pairs of closed neighbors
    blocks      squares of 2 × 2 closed cells
    isolated    closed cells with four open neighbors

Cells outside the map count as open. Without shape terms barriers are independent, P(closed) = σ(η_i). With pairs alone
this is the Ising model with an external field (Besag 1974, *Spatial interaction and the statistical analysis of lattice
systems*). Lines make walls long, a penalty on blocks keeps them thin: without it, the field has a phase in which nearly
every cell is closed.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Integer

from sidestep._arguments import to_finite, to_integers
from sidestep._repr import short_repr
from sidestep.errors import check, describe, to_number

SHAPE_TERMS = ("lines", "pairs", "blocks", "isolated")


@short_repr()
@dataclass(frozen=True, eq=False)
class BinaryMRF:
    """A binary Markov random field over barriers.

    Attributes:
        field: η of each barrier, its log-odds where no shape term counts.
        shape: The rows and columns where barriers are the cells of a grid; None where they are not.
        lines, pairs, blocks, isolated: The weights s, c, t and u in nats; 0 without a grid.

    Raises:
        InputError: For numbers that are not finite, a shape that does not fit, and weights without a shape.

    Example:
        >>> prior = BinaryMRF(np.full(3, -1.0), (1, 3), lines=0.5, pairs=0.25)
        >>> float(prior.log_density(np.array([1, 1, 1])))  # three cells, one line, two pairs
        -2.0
    """

    field: Float[np.ndarray, " barriers"]
    shape: tuple[int, int] | None = None
    lines: float = 0.0
    pairs: float = 0.0
    blocks: float = 0.0
    isolated: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "field", np.asarray(to_finite(self.field, "field", ("barriers",))))
        for name in SHAPE_TERMS:
            object.__setattr__(self, name, to_number(getattr(self, name), name))
        if self.shape is None:
            message = f"expected a shape, or no weights of shape terms, found {self.weights.tolist()}"
            check(not self.weights.any(), message, field="shape")
        else:
            rows, columns = to_integers(self.shape, "shape", (2,), least=1).tolist()
            fits = rows * columns == len(self.field)
            check(fits, f"expected {len(self.field)} cells, found {rows} × {columns}", field="shape")
            object.__setattr__(self, "shape", (rows, columns))

    @property
    def weights(self) -> Float[np.ndarray, " 4"]:
        """Return the weights of lines, pairs, blocks and isolated cells."""
        return np.array([getattr(self, name) for name in SHAPE_TERMS], dtype=np.float64)

    def log_density(
        self, closed: Bool[np.ndarray, "*maps barriers"] | Integer[np.ndarray, "*maps barriers"]
    ) -> Float[np.ndarray, "*maps"]:
        """Return log p(z) of maps in nats, up to a constant.

        Args:
            closed: Whether each barrier is closed.

        Raises:
            InputError: For anything but whether each barrier is closed.
        """
        maps = np.asarray(closed)
        fits = maps.dtype.kind in "biu" and maps.shape[-1:] == self.field.shape
        message = f"expected booleans, or 0 and 1, of {len(self.field)} barriers, found {describe(closed)}"
        check(fits, message, field="closed")
        total = maps @ self.field
        if self.shape is not None:
            cells = maps.astype(bool, copy=False).reshape(*maps.shape[:-1], *self.shape)
            total = total + shape_counts(cells) @ self.weights
        return np.asarray(total)


def shape_counts(closed: Bool[np.ndarray, "*maps rows columns"]) -> Int[np.ndarray, "*maps 4"]:
    """Return the numbers of lines, pairs, blocks and isolated cells of maps.

    Args:
        closed: Whether each cell is blocked.

    Example:
        >>> shape_counts(np.array([[1, 1, 1], [0, 0, 0], [1, 0, 0]], dtype=bool)).tolist()
        [1, 2, 0, 1]
    """
    padded = np.pad(closed, [(0, 0)] * (closed.ndim - 2) + [(1, 1)] * 2)
    inner, up, down = padded[..., 1:-1, 1:-1], padded[..., :-2, 1:-1], padded[..., 2:, 1:-1]
    left, right = padded[..., 1:-1, :-2], padded[..., 1:-1, 2:]
    lines = inner & ((left & right) | (up & down))
    isolated = inner & ~(left | right | up | down)
    blocks = inner & right & down & padded[..., 2:, 2:]
    pairs = (inner & right).sum((-1, -2)) + (inner & down).sum((-1, -2))
    return np.stack([lines.sum((-1, -2)), pairs, blocks.sum((-1, -2)), isolated.sum((-1, -2))], axis=-1)


def expected_shapes(padded: Any) -> list[Any]:
    """Return the mean numbers of lines, pairs, blocks and isolated cells of a map of independent cells.

    Each shape is a product of different cells, so the means are exact.

    Args:
        padded: P(closed) of each cell with a border of zeros around; an array of NumPy or JAX.

    Example:
        >>> [float(mean) for mean in expected_shapes(np.pad(np.array([[1.0, 0.5, 1.0]]), 1))]
        [0.5, 1.0, 0.0, 1.0]
    """
    inner, up, down = padded[1:-1, 1:-1], padded[:-2, 1:-1], padded[2:, 1:-1]
    left, right = padded[1:-1, :-2], padded[1:-1, 2:]
    lines = inner * (1 - (1 - left * right) * (1 - up * down))
    pairs = inner * (right + down)
    blocks = inner * right * down * padded[2:, 2:]
    isolated = inner * (1 - up) * (1 - down) * (1 - left) * (1 - right)
    return [lines.sum(), pairs.sum(), blocks.sum(), isolated.sum()]
