"""Checks of settings: what is refused, and in which words."""

# ruff: noqa: E501

from decimal import Decimal
from fractions import Fraction
from pathlib import Path, PurePosixPath

import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.errors import (
    InputError,
    check_choice,
    check_count,
    check_function,
    check_instance,
    check_positive,
    describe,
    to_count,
    to_list,
    to_number,
    to_path,
)


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


@pytest.mark.parametrize(
    "value", [2, 2.0, np.float32(2), np.int8(2), np.array(2.0), jnp.array(2), Fraction(2), Decimal(2)]
)
def test_to_number_of_numbers_returns_a_float(value):
    number = to_number(value, "rate", above=0, most=2)
    assert (number, type(number)) == (2.0, float)


@pytest.mark.parametrize("value", [2, np.uint8(2), np.array(2), jnp.array(2)])
def test_to_count_of_integers_returns_an_integer(value):
    number = to_count(value, "moves", 1, 2)
    assert (number, type(number)) == (2, int)


@pytest.mark.parametrize(("call", "message"), [
    (lambda: to_number("2", "rate"), "field 'rate': expected a finite number, found '2'"),
    (lambda: to_number(True, "rate"), "field 'rate': expected a finite number, found True"),
    (lambda: to_number(np.bool(True), "rate"), "field 'rate': expected a finite number, found True"),
    (lambda: to_number(np.ones(1), "rate"), "field 'rate': expected a finite number, found float64 of shape (1,)"),
    (lambda: to_number(10**400, "rate"), "field 'rate': expected a finite number, found int"),
    (lambda: to_number(1j, "rate"), "field 'rate': expected a finite number, found 1j"),
    (lambda: to_number(3, "rate", above=0, below=2), "field 'rate': expected a finite number above 0 and below 2, found 3"),
    (lambda: to_number(3, "rate", least=0, most=1), "field 'rate': expected a finite number from 0 to 1, found 3"),
    (lambda: to_number(3, "rate", most=1), "field 'rate': expected a finite number, at most 1, found 3"),
    (lambda: to_count(0, "moves", 1, 5), "field 'moves': expected 1…5, found 0"),
    (lambda: to_count(2.0, "moves", 1, 5), "field 'moves': expected a whole number, 1…5, found 2.0"),
    (lambda: check_instance(float, float, "x"), "field 'x': expected a float, found the class float"),
    (lambda: check_instance(None, (int, InputError), "x"), "field 'x': expected an int or InputError, found None"),
    (lambda: check_function("print", "report"), "field 'report': expected a function, found 'print'"),
    (lambda: check_choice([4], (4, 8), "x"), "field 'x': expected one of 4, 8, found [4]"),
    (lambda: check_choice(np.array([4, 8]), (4, 8), "x"), "field 'x': expected one of 4, 8, found int64 of shape (2,)"),
    (lambda: to_list([1, "a"], int, "x"), "field 'x[1]': expected an int, found 'a'"),
    (lambda: to_list("ab", str, "x"), "field 'x': expected a list, found 'ab'"),
    (lambda: to_list({"a": 1}, str, "x"), "field 'x': expected a list, found {'a': 1}"),
    (lambda: to_list(np.array(1), int, "x"), "field 'x': expected a list, found 1"),
    (lambda: to_list([1], int, "x", least=2), "field 'x': expected at least 2, found 1"),
    (lambda: to_path(b"a"), "field 'path': expected the path of a file, found b'a'"),
])  # fmt: skip
def test_wrong_value_raises_and_says_what_was_expected(call, message):
    with pytest.raises(InputError) as caught:
        call()
    assert str(caught.value) == message


@pytest.mark.parametrize("path", ["a/b", Path("a/b"), PurePosixPath("a/b")])
def test_to_path_of_texts_and_paths_returns_a_path(path):
    assert to_path(path) == Path("a/b")


def test_describe_of_long_values_is_short():
    nested = [list(range(100))] * 100
    for value in (
        nested,
        "a" * 10_000,
        10**1000,
        10**5000,
        [10**5000],
        np.zeros((100, 100)),
        tuple(nested),
        {"a": nested},
    ):
        assert len(describe(value)) < 200
