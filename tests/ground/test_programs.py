"""Compiled programs are kept from process to process."""

import os
import subprocess
import sys

import pytest

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

keep_compiled_code()
for values in (np.arange(3.0), np.arange(3.0) + 1, np.arange(4.0)):
    result = scaled(values, 2, "a")
    print(float(result.total), list(result.parts), float(calls_back(jnp.ones(3))[0]) == float(np.sin(np.float32(1))))
print(float(jax.grad(lambda x: scaled(x, 3, "b").total)(jnp.ones(2))[0]))
"""
NUMBERS = ["6.0 ['a'] True", "12.0 ['a'] True", "12.0 ['a'] True", "3.0"]


@pytest.fixture
def run(tmp_path):
    """Run the program with a cache of its own; returns the numbers that it prints, and what it traced."""

    def run() -> tuple[list[str], list[str]]:
        environment = {**os.environ, "SIDESTEP_CACHE": str(tmp_path / "cache"), "JAX_ENABLE_X64": "0"}
        (tmp_path / "program.py").write_text(PROGRAM)
        command = [sys.executable, str(tmp_path / "program.py")]
        done = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
        lines = done.stdout.splitlines()
        return [line for line in lines if "traces" not in line], [line for line in lines if "traces" in line]

    return run


def test_keep_program_in_a_second_process_traces_nothing_but_callbacks(run, tmp_path):
    numbers, traced = run()
    assert numbers == NUMBERS
    assert traced.count("traces a") == 2  # three and four numbers
    numbers, traced = run()
    assert numbers == NUMBERS
    # a gradient is traced as a whole
    assert set(traced) == {"traces the callback", "traces b"}
    assert len(list((tmp_path / "cache" / "programs").iterdir())) == 2


def test_keep_program_with_damaged_entries_replaces_them(run, tmp_path):
    run()
    for entry in (tmp_path / "cache" / "programs").iterdir():
        entry.write_bytes(entry.read_bytes()[:-1] + b"?")
    numbers, traced = run()
    assert numbers == NUMBERS
    assert traced.count("traces a") == 2
    assert set(run()[1]) == {"traces the callback", "traces b"}


def test_keep_program_with_another_version_of_a_library_traces_anew(run, tmp_path):
    run()
    (tmp_path / "optax.py").touch()  # beside the program, so that it is found first
    assert run()[1].count("traces a") == 2
