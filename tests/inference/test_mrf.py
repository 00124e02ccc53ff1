"""The binary Markov random field: its log density by counting, and the native change of it by a flip."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sidestep.errors import InputError
from sidestep.inference.mrf import BinaryMRF
from sidestep.inference.prior_kernels import MRFTerms, flip_prior

WEIGHTS = {"lines": 0.7, "pairs": -0.4, "blocks": -1.3, "isolated": 0.9}
MAPS = st.tuples(st.integers(1, 5), st.integers(1, 5), st.integers(0, 2**25 - 1))


def counted(closed: np.ndarray) -> dict[str, int]:
    """The numbers of shapes, cell by cell."""
    cells = {(int(r), int(c)) for r, c in np.argwhere(closed)}
    lines = pairs = blocks = isolated = 0
    for r, c in cells:
        across, along = {(r, c - 1), (r, c + 1)}, {(r - 1, c), (r + 1, c)}
        lines += across <= cells or along <= cells
        pairs += len((across | along) & cells)
        blocks += {(r, c + 1), (r + 1, c), (r + 1, c + 1)} <= cells
        isolated += not (across | along) & cells
    return {"lines": lines, "pairs": pairs // 2, "blocks": blocks, "isolated": isolated}


def a_map(shape_and_bits: tuple[int, int, int]) -> np.ndarray:
    rows, columns, bits = shape_and_bits
    return (bits >> np.arange(rows * columns) & 1).reshape(rows, columns)


@given(MAPS)
def test_log_density_equals_counting(shape_and_bits):
    closed = a_map(shape_and_bits)
    field = np.random.default_rng(0).normal(size=closed.size)
    expected = field[closed.ravel() == 1].sum() + sum(WEIGHTS[name] * n for name, n in counted(closed).items())
    for kind in (bool, np.int64):
        result = BinaryMRF(field, closed.shape, **WEIGHTS).log_density(closed.ravel().astype(kind))
        assert result == pytest.approx(expected)


@pytest.mark.parametrize(("name", "rows", "expected"), [
    ("lines", ["###", "...", "#.."], 1),
    ("lines", ["###", "###", "###"], 5),  # all but the corners
    ("pairs", ["##.", "#..", "..#"], 2),
    ("blocks", ["###", "##.", "..#"], 1),
    ("isolated", ["#.#", ".#.", "#.#"], 5),
    ("isolated", ["##", ".."], 0),
])  # fmt: skip
def test_log_density_of_one_weight_counts_its_shape(name, rows, expected):
    closed = np.array([[cell == "#" for cell in row] for row in rows])
    weights: dict[str, float] = {name: 1.0}
    assert BinaryMRF(np.zeros(closed.size), closed.shape, **weights).log_density(closed.ravel()) == expected


def flipped(closed: np.ndarray, cell: int, prior: BinaryMRF) -> tuple[float, np.ndarray]:
    """The native change of log p(z) by a flip, and the map after it."""
    z = closed.ravel().astype(np.uint8)
    terms = MRFTerms(prior.field, prior.weights, *(prior.shape or (0, 0)))
    return flip_prior(z, cell, terms), z


@given(MAPS)
def test_flip_prior_every_cell_equals_the_difference_of_log_densities(shape_and_bits):
    """At borders and corners, too."""
    closed = a_map(shape_and_bits)
    prior = BinaryMRF(np.random.default_rng(1).normal(size=closed.size), closed.shape, **WEIGHTS)
    for cell in range(closed.size):
        change, after = flipped(closed, cell, prior)
        expected = closed.ravel().copy()
        expected[cell] = 1 - expected[cell]
        np.testing.assert_array_equal(after, expected)
        assert change == pytest.approx(prior.log_density(expected) - prior.log_density(closed.ravel()), abs=1e-12)


def test_flip_prior_without_a_shape_is_the_field():
    prior = BinaryMRF(np.array([0.3, -1.2]))
    for z, cell in product(([0, 0], [0, 1], [1, 1]), (0, 1)):
        change, _ = flipped(np.array(z), cell, prior)
        assert change == pytest.approx((1 - 2 * z[cell]) * prior.field[cell])


@pytest.mark.parametrize(("arguments", "field"), [
    ({"field": np.array([0.0, np.nan])}, "field"),
    ({"field": np.array([0.0, np.inf]), "shape": (1, 2)}, "field"),
    ({"field": np.zeros(2), "shape": (1, 2), "lines": np.nan}, "lines"),
    ({"field": np.zeros(2), "shape": (1, 2), "blocks": -np.inf}, "blocks"),
    ({"field": np.zeros(2), "pairs": 1.0}, "shape"),
    ({"field": np.zeros(2), "shape": (1, 3)}, "shape"),
])  # fmt: skip
def test_binary_mrf_with_bad_numbers_raises(arguments, field):
    with pytest.raises(InputError, match=field):
        BinaryMRF(**arguments)
