"""Runtime checks of types and shapes, for `--jaxtyping-packages`."""

from beartype import beartype


def checked(function):
    """Return the function with checks by beartype; unchanged if it is defined in another function.

    The checks are compiled where a function is defined. For a nested function that is every call of the outer one,
    which has checks of its own.
    """
    return function if "<locals>" in function.__qualname__ else beartype(function)
