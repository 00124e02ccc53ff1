"""Machine code that is kept is not used after a part of it has changed, in whatever folder the part is."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

HEADER = "from sidestep.tabular.solvers.native import compiled, inlined\n"
MODULES = {
    "part/part.py": HEADER + "@inlined()\ndef part(x):\n    return x + 1\n",
    "middle/middle.py": HEADER + "from part.part import part\n@inlined()\ndef middle(x):\n    return 10 * part(x)\n",
    "kernels/kernels.py": HEADER
    + """
from middle.middle import middle

def closure(factor, function=middle):
    @inlined()
    def inner(x):
        return factor * function(x)

    @compiled()
    def outer(x):
        return inner(x)

    return outer

@compiled()
def direct(x):
    return middle(x)
""",
    "program.py": """
from kernels.kernels import closure, direct
for function in (direct, closure(2), closure(3)):
    print(function(1), sum(function.dispatcher().stats.cache_hits.values()))
""",
}
"""Modules in folders of their own: `direct` and `closure` are compiled with `middle`, and that with `part`."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("code")
    for name, text in MODULES.items():
        write(folder / name, text)
    assert run(folder) == (["20", "40", "60"], ["0"] * 3)
    return folder


def write(path: Path, text: str) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)


def run(folder: Path) -> tuple[list[str], list[str]]:
    """Return the numbers of the three functions in a process of its own, and how often kept code was read."""
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    # sources that change within a second look the same to Python's own cache
    environment |= {"SIDESTEP_CACHE": str(folder / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
    environment["PYTHONPATH"] = os.pathsep.join([str(folder), *(path for path in sys.path if path)])
    command = [sys.executable, str(folder / "program.py")]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    numbers, hits = zip(*(line.split() for line in done.stdout.splitlines()), strict=True)
    return list(numbers), list(hits)


def test_kept_code_is_read_while_nothing_changes(folder):
    assert run(folder) == (["20", "40", "60"], ["1"] * 3)


@pytest.mark.parametrize(("name", "old", "new", "expected"), [
    ("part/part.py", "x + 1", "x + 2", ["30", "60", "90"]),
    ("middle/middle.py", "10 *", "100 *", ["200", "400", "600"]),
    ("kernels/kernels.py", "factor *", "1 + factor *", ["20", "41", "61"]),
])  # fmt: skip
def test_kept_code_is_not_read_after_a_part_of_it_has_changed(folder, name, old, new, expected):
    write(folder / name, MODULES[name].replace(old, new))
    try:
        assert run(folder) == (expected, ["0"] * 3)
        assert run(folder) == (expected, ["1"] * 3)
    finally:
        write(folder / name, MODULES[name])


def test_kept_code_of_a_closure_is_of_the_values_that_it_closes_over(folder):
    """After a run with other values, those of the first are still there."""
    write(folder / "program.py", MODULES["program.py"].replace("closure(2), closure(3)", "closure(5), closure(3)"))
    try:
        assert run(folder) == (["20", "100", "60"], ["1", "0", "1"])
    finally:
        write(folder / "program.py", MODULES["program.py"])
