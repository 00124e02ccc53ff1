"""Checks of settings: what is refused, and in which words."""

import numpy as np
import pytest

from sidestep.errors import InputError, check_count, check_positive


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (1, "'moves': expected at least 2, found 1"),
        (np.int64(-3), "'moves': expected at least 2, found -3"),
        (2.5, "'moves': expected a whole number, at least 2, found 2.5"),
        (True, "'moves': expected at least 2, found True"),
        (None, "'moves': expected a whole number, at least 2, found None"),
    ],
)
def test_check_count_of_other_values_raises(value, message):
    with pytest.raises(InputError, match=message):
        check_count(value, 2, "moves")


@pytest.mark.parametrize("value", [2, 7, np.int32(2)])
def test_check_count_accepts_counts(value):
    assert check_count(value, 2, "moves") is None


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_check_positive_accepts_finite_numbers_above_0_only(value):
    with pytest.raises(InputError, match="'rate': expected a finite number above 0, found"):
        check_positive(value, "rate")
    assert check_positive(1e-300, "rate") is None
