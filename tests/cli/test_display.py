"""What the command line prints of numbers."""

import pytest

from sidestep.cli.display import with_error


@pytest.mark.parametrize(
    ("estimate", "error", "text"),
    [
        (5.2371, 0.4123, "5.2 ± 0.4"),
        (5.2371, 0.1423, "5.24 ± 0.14"),
        (430.2, 313.4, "430 ± 313"),
        (0.01513, 0.00994, "0.015 ± 0.010"),
        (1.0, 0.0999, "1.00 ± 0.10"),
        (5.2371, None, "5.24"),
    ],
)
def test_with_error_has_the_digits_of_the_error(estimate, error, text):
    assert with_error(estimate, error) == text
