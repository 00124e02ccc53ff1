"""What the tests of the continuous half share."""

import jax
import pytest


@pytest.fixture(scope="module")
def unoptimised():
    """Compiled quickly rather than well: these tests compile large functions, several times, and run them briefly."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", before)
