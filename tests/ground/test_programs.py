"""Compiled programs are kept from process to process."""

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow

PROGRAM = """
import jax, jax.numpy as jnp, numpy as np
from typing import NamedTuple
from sidestep._cache import keep_compiled_code
from sidestep._programs import keep_program

class Result(NamedTuple):
    total: jax.Array
    parts: dict

@keep_program
def scaled(values, factor, name):
    print("traces", name)
    return Result(factor * values.sum(), {name: factor * values})

@keep_program
def calls_back(values):
    print("traces the callback")
    return jax.pure_callback(np.sin, jax.ShapeDtypeStruct(values.shape, values.dtype), values)
@keep_program
def inverse(matrix):
    print("traces an inverse")
    return jnp.linalg.inv(matrix)  # by LAPACK, whose functions have to be registered
@keep_program
def total(result):  # of a class that no key knows
    print("traces a class")
    return result.total

keep_compiled_code()
for values in (np.arange(3.0), np.arange(3.0) + 1, np.arange(4.0)):
    result = scaled(values, 2, "a")
    print(float(total(result)), list(result.parts), float(calls_back(jnp.ones(3))[0]) == float(np.sin(np.float32(1))))
print(float(inverse(np.eye(2) / 2)[0, 0]))
print(float(jax.grad(lambda x: scaled(x, 3, "b").total)(jnp.ones(2))[0]))
"""
NUMBERS = ["6.0 ['a'] True", "12.0 ['a'] True", "12.0 ['a'] True", "2.0", "3.0"]


def run(folder):
    """Run the program with a cache of its own; returns what it traced. Its numbers are always the same."""
    environment = {**os.environ, "SIDESTEP_CACHE": str(folder / "cache"), "JAX_ENABLE_X64": "0"}
    (folder / "program.py").write_text(PROGRAM)
    command = [sys.executable, str(folder / "program.py")]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
    lines = done.stdout.splitlines()
    assert [line for line in lines if "traces" not in line] == NUMBERS
    return [line for line in lines if "traces" in line]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a cache that one process has filled."""
    folder = tmp_path_factory.mktemp("programs")
    assert run(folder).count("traces a") == 2  # three and four numbers
    return folder


def test_keep_program_in_a_second_process_traces_nothing_but_callbacks(folder):
    # a gradient is traced as a whole
    assert set(run(folder)) == {"traces the callback", "traces b", "traces a class"}
    assert len(list((folder / "cache" / "programs").iterdir())) == 3


def test_keep_program_with_damaged_entries_replaces_them(folder):
    for entry in (folder / "cache" / "programs").iterdir():
        entry.write_bytes(entry.read_bytes()[:-1] + b"?")
    assert run(folder).count("traces a") == 2
    assert set(run(folder)) == {"traces the callback", "traces b", "traces a class"}


def test_keep_program_with_another_version_of_a_library_traces_anew(folder):
    (folder / "optax.py").touch()  # beside the program, so that it is found first
    assert run(folder).count("traces a") == 2
