"""New processes: what they import, and compiled code that they keep."""

import os
import subprocess
import sys

import matplotlib as mpl
import numpy as np
import pytest

from sidestep._version import __version__
from sidestep.maps.learned_map import LearnedMap
from sidestep.tabular.grid import Grid
from sidestep.tabular.reward import Reward

pytestmark = pytest.mark.slow

COMMAND = "import sys; from sidestep.cli.app import main; code = main(sys.argv[1:])"
MODULES = "; print(*sorted(sys.modules))"
PLAN = ("plan", "learned", "--start", "0.5,0.5", "--goal", "2.5,0.5", "--out")


def start(program, *arguments, **options):
    """Start Python with a program; without other caches than that of `sidestep`."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    options["env"] = environment | options.get("env", {})
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)


def output(process):
    """Return what a process prints; it must succeed and say nothing on stderr."""
    printed, errors = process.communicate(timeout=240)
    assert (process.returncode, errors) == (0, "")
    return printed


@pytest.mark.parametrize(("program", "arguments", "expected", "libraries"), [
    (COMMAND + MODULES, ["--help"], "Usage", {"jax", "matplotlib", "sklearn"}),
    (COMMAND + MODULES, ["--version"], __version__, {"jax", "matplotlib", "sklearn"}),
    ("import sys, sidestep" + MODULES, [], "", {"matplotlib", "sklearn", "pyarrow", "numba", "scipy"}),
])  # fmt: skip
def test_import_loads_no_library_before_it_is_needed(program, arguments, expected, libraries):
    printed = output(start(program, *arguments))
    assert expected in printed
    assert "sidestep" in printed.split()
    assert not libraries & set(printed.split())


@pytest.fixture
def folder(tmp_path):
    """A folder with a learned map."""
    blocked, visited = np.array([[0.01, 0.9, 0.01], [0.01, 0.01, 0.01]]), np.zeros((0, 2), dtype=int)
    LearnedMap(Grid.unknown(2, 3), blocked, visited, Reward()).save(tmp_path / "learned", command="learn")
    return tmp_path


def plan(folder, out, cache):
    """Start `sidestep plan` in a folder; matplotlib has its own cache."""
    places = {"HOME": folder / "home", "SIDESTEP_CACHE": cache, "MPLCONFIGDIR": mpl.get_cachedir()}
    places |= {"XDG_CACHE_HOME": folder / "home"}
    env = {name: str(value) for name, value in places.items()}
    return start(COMMAND + "; sys.exit(code)", *PLAN, out, cwd=folder, env=env)


def test_plan_with_cache_off_keeps_no_compiled_code(folder):
    assert "moves" in output(plan(folder, "out", "off"))
    assert not (folder / "home").exists()
    assert not (folder / "off").exists()


def test_plan_shares_a_cache_and_rebuilds_damaged_entries(folder):
    """Two processes share an empty cache; then all entries are damaged."""
    both = [plan(folder, name, folder / "cache") for name in ("one", "other")]
    printed = {output(process).replace("other", "one") for process in both}
    sizes = {path: path.stat().st_size for path in (folder / "cache").rglob("*") if path.is_file()}
    assert sizes
    for path, size in sizes.items():
        os.truncate(path, size // 2)
    printed.add(output(plan(folder, "third", folder / "cache")).replace("third", "one"))
    assert len(printed) == 1
    paths = {(folder / name / "path.csv").read_text() for name in ("one", "other", "third")}
    assert len(paths) == 1
    assert all(path.stat().st_size > 0.9 * size for path, size in sizes.items())
