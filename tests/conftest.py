"""All tests run in 64-bit numbers; the library never changes JAX's configuration, and the command line does.

Import nothing of `sidestep` above `pytest_configure`: jaxtyping's checks must be switched on first.
Compiled code is kept from run to run, in the folder that the environment variable `SIDESTEP_CACHE` names.
"""

import gc
import os
from pathlib import Path

# The suite compiles thousands of functions and runs each for milliseconds: without optimization, and by one thread in
# each process, they compile sooner.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false "
    "--xla_cpu_parallel_codegen_split_count=1 --xla_cpu_multi_thread_eigen=false",
)

import jax
import pytest
from hypothesis import settings

gc.set_threshold(50_000)  # a search for garbage visits all that JAX and the collected tests hold
jax.config.update("jax_enable_x64", True)

settings.register_profile("sidestep", deadline=None, max_examples=25)
settings.load_profile("sidestep")


def pytest_configure():
    """Keep what is compiled from run to run.

    Kept programs are not traced again, and so not checked again by beartype. But they belong to the files of the
    package, and no program is kept for classes of the tests; so whatever changes is traced and checked.
    """
    from sidestep._cache import keep_compiled_code

    keep_compiled_code()


@pytest.fixture(scope="module", autouse=True)
def _few_mappings():
    """Drop compiled code before it takes more mappings of memory than Linux lets a process have: 65,530."""
    yield
    mappings = Path("/proc/self/maps")
    if mappings.exists() and len(mappings.read_bytes().splitlines()) > 25_000:
        jax.clear_caches()


@pytest.fixture(scope="module")
def datasets(tmp_path_factory):
    """A folder of the tests' own in which Minari keeps its datasets."""
    folder = tmp_path_factory.mktemp("datasets")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(folder))
        yield folder
