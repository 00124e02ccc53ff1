"""Checks of tables of probabilities that come in by hand: each row a distribution."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from sidestep.errors import InputError, check

TOLERANCE = 1e-5
"""How far the probabilities of a row may be from a sum of 1; wide enough for tables in 32 bits."""


def check_distribution(
    probabilities: Float[np.ndarray, " outcomes"], *, source: object | None = None, field: str | None = None
) -> None:
    """Raise `InputError` unless probabilities are finite, not negative, and sum to 1.

    Args:
        probabilities: Of the outcomes of one choice.
        source: The place of the row, for the message.
        field: The argument, for the message.
    """
    wrong = probabilities[~(probabilities >= 0) | ~np.isfinite(probabilities)][:1]
    check(not len(wrong), f"expected probabilities of at least 0, found {wrong}", source=source, field=field)
    total = float(probabilities.sum(dtype=np.float64))
    if not abs(total - 1) <= TOLERANCE:
        message = f"expected probabilities that sum to 1, found a sum of {total:g}"
        raise InputError(message, source=source, field=field)


def check_distributions(
    table: Float[np.ndarray, "*rows outcomes"],
    names: Sequence[str],
    *,
    counts: Bool[np.ndarray, "*#rows"] | bool = True,
    field: str | None = None,
) -> None:
    """Raise `InputError`, with the place, for the first row of a table that counts and is no distribution.

    Args:
        table: The probabilities.
        names: The name of each axis of rows, for the message.
        counts: Whether each row counts; by default all do.
        field: The argument, for the message.
    """
    with np.errstate(invalid="ignore"):  # of ∞ − ∞
        valid = (table >= 0).all(axis=-1) & (np.abs(table.sum(axis=-1, dtype=np.float64) - 1) <= TOLERANCE)
    for place in np.argwhere(counts & ~valid)[:1].tolist():
        source = ", ".join(f"{name} {index}" for name, index in zip(names, place, strict=True))
        check_distribution(table[tuple(place)], source=source, field=field)
