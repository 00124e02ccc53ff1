"""The information of a posterior as a diagonal scale and some directions: of the whole, or of its largest parts.

Where few parameters are learned, H is computed as a whole. Where many are, with D the prior's information of each
parameter (the row sums of its Hessian),

    D^−½ H D^−½ = 1 + Σ_j λ_j v_j v_jᵀ

has few λ that differ from 0, because walks say little of most of a large map; the largest ones are computed by Lanczos
iterations (ARPACK), and the others left out. This is the low-rank approximation of Bui-Thanh, Ghattas, Martin and
Stadler (2013), in all but that D need not be the whole of the prior.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sidestep.errors import NotConverged, check
from sidestep.inference.information import Information


class Decomposition(NamedTuple):
    """H = S⁻¹ (1 + V (M − 1) Vᵀ) S⁻¹, with S a diagonal matrix, V orthonormal and M diagonal.

    Attributes:
        scale: The diagonal of S.
        vectors: V, in its columns.
        eigenvalues: M.
        neglected: A bound of |M − 1| of the directions that are left out; 0 where there are none.
    """

    scale: Float[np.ndarray, " parameters"]
    vectors: Float[np.ndarray, "parameters vectors"]
    eigenvalues: Float[np.ndarray, " vectors"]
    neglected: float


def whole(information: Information) -> Decomposition:
    """Return all directions.

    Args:
        information: The information.

    Raises:
        InputError: For second derivatives that are not finite.
    """
    matrix = information.dense()
    diagonal = np.diag(matrix)
    message = f"expected finite second derivatives, found {np.count_nonzero(~np.isfinite(matrix))} that are not"
    check(np.isfinite(matrix).all(), message, source="laplace", field="fit")
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1))
    eigenvalues, vectors = np.linalg.eigh(scale[:, None] * matrix * scale)
    return Decomposition(scale, vectors, eigenvalues, 0.0)


def low_rank(information: Information, rank: int) -> Decomposition:
    """Return the directions that differ most from the prior.

    Args:
        information: The information.
        rank: Their number, 1 or more.

    Raises:
        InputError: For a prior that says nothing of any parameter.
        NotConverged: If the Lanczos iterations do not converge.
    """
    from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh

    size = information.size
    rows = information.of_prior(np.ones((1, size)))[0]
    message = "expected a prior that says something of each parameter, where there are many"
    check((rows > 0).any() and np.isfinite(rows).all(), message, source="laplace", field="prior")
    scale = 1 / np.sqrt(np.where(rows > 0, rows, np.median(rows[rows > 0])))

    def beside_prior(vector: np.ndarray) -> np.ndarray:
        vector = vector.ravel()
        return scale * information.products((scale * vector)[None])[0] - vector

    operator = LinearOperator((size, size), matvec=beside_prior, dtype=np.float64)  # pyright: ignore[reportCallIssue]
    start = np.random.default_rng(0).normal(size=size)
    try:
        largest, vectors = eigsh(operator, min(rank, size - 1), which="LM", v0=start)
    except ArpackNoConvergence as error:
        raise NotConverged(
            f"the information's eigenvalues did not converge: a smaller rank may help ({error})"
        ) from error
    return Decomposition(scale, vectors, 1 + largest, float(np.abs(largest).min()))
