"""Help, exit codes, and one line for every error in the input."""

from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import yaml

import sidestep
from sidestep.cli import display
from sidestep.cli.app import main
from sidestep.cli.options import present_spelling
from sidestep.io.maps import write_map
from sidestep.maps.learned_map import LearnedMap
from sidestep.tabular.grid import Grid
from sidestep.tabular.reward import Reward

COMMANDS = ("demo", "reproduce", "learn", "plan", "evaluate", "simulate")
WALKS = """walk,step,x,y,goal_x,goal_y
a,0,0.5,0.5,2.5,1.5
a,1,1.5,0.5,2.5,1.5
a,2,2.5,0.5,2.5,1.5
a,3,2.5,1.5,2.5,1.5
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with `walks.csv` and a map of 2 × 3 cells, the upper middle one known to be occupied."""
    monkeypatch.chdir(tmp_path)
    Path("walks.csv").write_text(WALKS)
    write_map("map.yaml", np.array([[0.5, 1.0, 0.5], [0.5, 0.5, 0.0]]), Grid.unknown(2, 3))
    return tmp_path


def run(arguments: str) -> int:
    """Return the exit code of `sidestep` with these arguments."""
    return main(arguments.split())


def written(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def refused(here: Path, capsys, arguments: str, *expected: str) -> None:
    """Check for exit code 1, one line with all expected texts, and no new file."""
    before = written(here)
    assert run(arguments) == 1
    printed = capsys.readouterr()
    lines = printed.err.strip().splitlines()
    assert len(lines) == 1, printed.err
    for text in ("error: ", *expected):
        assert text in lines[0]
    assert "Traceback" not in printed.err
    assert "sidestep failed" not in printed.err
    assert written(here) == before


@pytest.mark.parametrize("command", COMMANDS)
def test_main_with_help_prints_an_example(command, capsys):
    assert main([command, "--help"]) == 0
    text = capsys.readouterr().out
    assert f"Example: sidestep {command}" in text
    assert "--out" in text


@pytest.mark.parametrize("arguments", [
    "",
    "explore",
    "learn walks.csv --out out",  # no map
    "learn walks.csv --map map.yaml",  # no folder for the map
    "learn --map map.yaml --out out",  # no walks
    "learn walks.csv --map map.yaml --out out --beta much",
    "learn walks.csv --map map.yaml --out out --connectivity 6",
    "learn walks.csv --map map.yaml --out out --backup softmax",
    "learn walks.csv --map map.yaml --out out --terms none",
    "learn walks.csv --map map.yaml --out out --seed -1",
    "learn walks.csv --map map.yaml --out out --faster",
    "plan learned --start abc --goal 1,1",
    "plan learned --start 1,1 --goal 1,2,3",
    "plan learned --start 1,1",
    "evaluate learned",
    "simulate map.yaml",
    "demo --seed x",
])  # fmt: skip
def test_main_with_wrong_usage_returns_2(here, arguments, capsys):
    before = written(here)
    assert run(arguments) == 2
    printed = capsys.readouterr()
    assert "Traceback" not in printed.err
    assert printed.err + printed.out
    assert written(here) == before


ROWS = {
    "outside the map": ("a,3,2.5,1.5", "a,3,2.5,7.5", "row 4", "field 'y'", "7.5"),
    "text": ("a,1,1.5,0.5", "a,1,1.5,far", "row 2", "field 'y'", "'far'"),
    "a walk of one point": ("a,0,", "b,0,", "row 1", "field 'walk'", "'b'"),
    "a walk through a known obstacle": ("a,1,1.5,0.5", "a,1,1.5,1.5", "row 2", "occupied"),
    "a missing column": ("walk,step,x,y", "walk,step,x,z", "field 'y'"),
    "walks that start at their goal": ("2.5,1.5\n", "0.5,0.5\n", "starts at its goal"),
}


@pytest.mark.parametrize("name", ROWS)
def test_learn_with_invalid_walks_names_row_and_field(here, capsys, name):
    good, bad, *expected = ROWS[name]
    assert good in WALKS
    Path("walks.csv").write_text(WALKS.replace(good, bad))
    refused(here, capsys, "learn walks.csv --map map.yaml --out out", "walks.csv", *expected)


KEYS = {"image": (None, "missing"), "origin": ([0, 0], "three numbers"), "mode": ("rainbow", "trinary")}


@pytest.mark.parametrize("key", KEYS)
def test_learn_and_simulate_with_an_invalid_map_name_the_field(here, capsys, key):
    value, expected = KEYS[key]
    entries = yaml.safe_load(Path("map.yaml").read_text()) | {key: value}
    Path("map.yaml").write_text(yaml.safe_dump({key: value for key, value in entries.items() if value is not None}))
    refused(here, capsys, "learn walks.csv --map map.yaml --out out", "map.yaml", f"field '{key}'", expected)
    refused(here, capsys, "simulate map.yaml --out new.csv", "map.yaml", f"field '{key}'", expected)


@pytest.mark.parametrize(("options", "expected"), [
    ("--beta 0", "field 'beta'"),
    ("--beta nan", "field 'beta'"),
    ("--discount 0", "field 'discount'"),
    ("--discount 1.1", "field 'discount'"),
    ("--discount 1", "field 'discount'"),
    ("--step-cost -1", "field 'step_cost'"),
    ("--prior normal --prior-variance 0", "field 'prior variance'"),
    ("--prior normal --prior-mean inf", "field 'prior mean'"),
    ("--horizon 0", "field 'horizon'"),
    ("--max-iterations 0", "field 'max_iterations'"),
    ("--max-walks 0", "field 'max_walks'"),
    ("--max-walks 2", "field 'max_walks'"),
    ("--backup logsumexp --discount 1 --step-cost 1 --beta 1", "log-sum-exp"),
])  # fmt: skip
def test_learn_with_invalid_settings_names_the_field(here, capsys, options, expected):
    refused(here, capsys, f"learn walks.csv --map map.yaml --out out {options}", expected)


def test_learn_with_an_unreachable_goal_names_the_row(here, capsys):
    write_map("map.yaml", np.array([[0.5, 1.0, 0.5], [0.5, 1.0, 0.0]]), Grid.unknown(2, 3))
    Path("walks.csv").write_text("walk,step,x,y,goal_x,goal_y\na,0,0.5,0.5,2.5,1.5\na,1,0.5,1.5,2.5,1.5\n")
    command = "learn walks.csv --map map.yaml --out out --discount 1 --step-cost 1"
    refused(here, capsys, command, "walks.csv, row 2", "cannot be reached")


@pytest.mark.parametrize(("arguments", "expected"), [
    ("learn none.csv --map map.yaml --out out", "none.csv"),
    ("learn walks.txt --map map.yaml --out out", "walks.txt"),
    ("learn walks.csv --map none.yaml --out out", "none.yaml"),
    ("plan nowhere --start 1,1 --goal 2,2", "summary.json"),
    ("evaluate nowhere --true-map map.yaml", "summary.json"),
    ("simulate none.yaml --out new.csv", "none.yaml"),
    ("simulate map.yaml --out new.csv", "free cells"),
    ("simulate map.yaml --out new.csv --walks 0", "field 'walks'"),
    ("simulate map.yaml --out new.csv --goals 0", "field 'goals'"),
])  # fmt: skip
def test_commands_with_missing_files_or_invalid_numbers_name_them(here, capsys, arguments, expected):
    if expected == "free cells":
        write_map("map.yaml", np.array([[0.0, 1.0, 0.0]]), Grid.unknown(1, 3))
        arguments += " --goals 1"
    refused(here, capsys, arguments, expected)


def test_learn_into_a_folder_that_cannot_be_written_is_refused(here, capsys):
    Path("taken").write_text("a file, not a folder")
    refused(here, capsys, "learn walks.csv --map map.yaml --out taken/out", "taken", "cannot be written")


class TestWithALearnedMap:
    """`plan` and `evaluate` with a map that was learned from one walk."""

    @pytest.fixture
    def learned(self, here):
        assert run("learn walks.csv --map map.yaml --out learned --terms transitions") == 0
        write_map("true.yaml", np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]), Grid.unknown(2, 3))
        write_map("other.yaml", np.zeros((3, 3)), Grid.unknown(3, 3))
        write_map("finer.yaml", np.zeros((2, 3)), Grid(np.zeros((2, 3), dtype=int), resolution=0.5))
        return here

    def test_plan_and_evaluate_with_other_maps_or_positions_are_refused(self, learned, capsys):
        capsys.readouterr()
        for arguments, *expected in (
            ("plan learned --start 0.5,0.5 --goal 9,0.5", "field 'goal'", "on the map, x in"),
            ("plan learned --start nan,0.5 --goal 0.5,0.5", "field 'start'", "on the map, x in"),
            ("plan learned --start 0.5,0.5 --goal 1.5,1.5", "field 'goal'", "known obstacle"),
            ("plan learned --start 1.5,1.5 --goal 0.5,0.5", "field 'start'", "known obstacle"),
            ("evaluate learned --true-map other.yaml", "other.yaml", "2 × 3"),
            ("evaluate learned --true-map finer.yaml", "finer.yaml", "field 'resolution'"),
            ("evaluate learned --true-map none.yaml", "none.yaml"),
        ):
            refused(learned, capsys, arguments, *expected)
        Path("learned/blocked.npy").write_bytes(b"broken")
        refused(learned, capsys, "plan learned --start 0.5,0.5 --goal 2.5,0.5", "blocked.npy")
        refused(learned, capsys, "evaluate learned --true-map true.yaml", "blocked.npy")

    def test_plan_without_a_path_is_refused(self, learned, capsys):
        capsys.readouterr()
        blocked = np.load("learned/blocked.npy")
        blocked[1, 1] = 1
        np.save("learned/blocked.npy", blocked)
        refused(learned, capsys, "plan learned --start 0.5,0.5 --goal 2.5,0.5", "expected a path from (0.5, 0.5)")


def test_main_with_a_failing_callback_prints_one_line_and_writes_no_map(here, capsys, monkeypatch):
    """A defect of the program: one line, no traceback, no half-written map."""

    @contextmanager
    def failing_progress(_):
        yield lambda progress: print(1 / (2 - progress.iteration))

    monkeypatch.setattr(display, "fit_progress", failing_progress)
    assert run("learn walks.csv --map map.yaml --out out") == 1
    assert capsys.readouterr().err.strip().splitlines() == [
        "error: sidestep failed (ZeroDivisionError: division by zero); set SIDESTEP_DEBUG=1 for details to report"
    ]
    assert written(here / "out") <= {"fit.checkpoint"}


def test_main_with_version_prints_the_version(capsys):
    assert run("--version") == 0
    assert capsys.readouterr().out.strip() == version("sidestep") == sidestep.__version__


@pytest.mark.parametrize(("old", "present"), [
    ("--behavior auto", "--behavior auto"),
    ("--behavior=given", ""),
    ("--unknown sharpness --unknown=lapses", "--learn beta --learn lapse"),
    ("--person name --candidates g.csv", "--person-column name --goal-candidates g.csv"),
    ("--lines 2 --sample 3 --iterations=4 --truth t", "--wall-prior 2 --max-walks 3 --max-iterations=4 --true-map t"),
])  # fmt: skip
def test_present_spelling_of_version_0_1_options_returns_those_of_today(old, present):
    assert present_spelling(old.split()) == present.split()


def test_evaluate_against_a_map_without_obstacles_says_that_there_is_no_ranking(here, capsys):
    grid = Grid.unknown(2, 3)
    LearnedMap(grid, np.full((2, 3), 0.2), np.array([[0, 5]]), Reward()).save(here / "learned")
    write_map("free.yaml", np.zeros((2, 3)), grid)
    assert run("evaluate learned --true-map free.yaml") == 0
    assert "there is no ranking" in " ".join(capsys.readouterr().err.split())
