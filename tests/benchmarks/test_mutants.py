"""Mutants: what counts as a mutation, which tests run, and small checkouts with good tests and bad ones."""

import json
import os
import textwrap

import pytest
from benchmarks.__main__ import main

from benchmarks import mutant_tests, mutants, mutations

MODULE = '''
"""Sums."""

from functools import lru_cache

LIMIT = 3
_CHUNK = 64


@lru_cache(maxsize=5)
def total(numbers: list[int] | None, start: int = 0) -> int:
    """Return the sum of numbers."""
    if start > LIMIT:
        raise ValueError(f"expected at most {LIMIT + 0}", 4)
    result = start
    for number in numbers or ():
        result += (number
                   + 0)
    return result


def half(number):
    return number / 2


def several(numbers):
    return numbers.shape[0] > 1


class Sum:
    def __repr__(self):
        return "sum" + "!"
'''


def line_of(text):
    return next(number for number, line in enumerate(MODULE.splitlines(), 1) if text in line)


@pytest.mark.parametrize(
    ("before", "after", "counts"),
    [
        ("return number / 2", "return number * 2", True),
        ("start > LIMIT", "start >= LIMIT", True),
        ("LIMIT = 3", "LIMIT = 4", True),
        ("_CHUNK = 64", "_CHUNK = 65", False),
        ("numbers.shape[0] > 1", "numbers.shape[0] != 1", False),
        ("numbers.shape[0] > 1", "numbers.shape[0] < 1", True),
        ("start: int = 0", "start: int = 1", True),
        ("numbers or ()", "numbers and ()", True),
        ("list[int] | None", "list[int] & None", False),
        ("(maxsize=5)", "(maxsize=6)", False),
        ("{LIMIT + 0}", "{LIMIT - 0}", False),
        ('}", 4)', '}", 5)', False),
        ('"sum" + "!"', '"sum" * "!"', False),
        ("sum of numbers", "product of numbers", True),  # no operator changes a docstring
        ("return number / 2", "return number / / 2", False),
    ],
)
def test_may_change_result_leaves_out_types_texts_and_speed(before, after, counts):
    assert mutations.may_change_result(MODULE, MODULE.replace(before, after)) is counts


def test_sites_of_stay_within_a_family_and_know_stars():
    source = "def f(*values, **options):\n    return g(*values, **options) + values[0] * 2 == -1\n"
    places = list(mutations.sites_of(source, "f.py"))
    assert {place.line for place in places} == {2}
    names = {name.partition("/")[2] for place in places for name, _ in place.mutations}
    arithmetic = {"Add", "Sub", "Mul", "Div", "FloorDiv", "Mod", "Pow"}
    replaced = {f"ReplaceBinaryOperator_{old}_{new}" for old in ("Add", "Mul") for new in arithmetic - {old}}
    compared = {f"ReplaceComparisonOperator_Eq_{new}" for new in ("NotEq", "Lt", "LtE", "Gt", "GtE")}
    assert names == {*replaced, *compared, "ReplaceUnaryOperator_Delete_USub", "NumberReplacer"}


def test_draw_mutations_are_those_of_the_seed_at_different_places(tmp_path):
    (tmp_path / "tabular").mkdir()
    (tmp_path / "tabular" / "sums.py").write_text(MODULE)

    def draw(count, seed):
        return list(mutations.draw_mutations(tmp_path, "tabular", count, seed))

    everything = draw(100, 0)
    assert draw(4, 0) == everything[:4]
    assert [each.code for each in draw(100, 1)] != [each.code for each in everything]
    codes = [each.code for each in everything]
    assert len(set(codes)) == len(codes) < 30
    assert MODULE not in codes
    changed = {each.line for each in everything}
    assert {line_of("LIMIT = 3"), line_of("for number"), line_of("number / 2")} <= changed
    assert changed.isdisjoint({line_of("maxsize"), line_of("raise"), line_of('"sum"')})


def test_statement_lines_are_those_of_the_innermost_statement():
    two = line_of("result += (number")
    within = mutant_tests.statement_lines
    assert within(MODULE, two + 1) == range(two, two + 2)
    assert within(MODULE, line_of("for number")) == range(two - 1, two)
    assert within(MODULE, line_of("number / 2")) == range(two + 6, two + 7)
    assert within(MODULE, line_of("LIMIT = 3")) is None
    # defaults of a function belong to its body
    assert within(MODULE, line_of("def total")) == range(line_of('"""Return the sum'), line_of("return result") + 1)


def test_choose_takes_tests_that_execute_the_line_first(tmp_path):
    folder = tmp_path / "src" / "sidestep" / "tabular"
    folder.mkdir(parents=True)
    (folder / "sums.py").write_text(MODULE)
    (folder / "user.py").write_text(
        "from sidestep.tabular.sums import half\n\n\ndef quarter(x):\n    return half(x) / 2\n"
    )
    line = line_of("number / 2")
    module, other = "tabular/sums.py", "tabular/user.py"

    def chosen(line, budget=100.0):
        return [each.test for each in mutant_tests.choose(tmp_path, module, line, records, budget)]

    hit = {module: {str(line): [1, 2], "1": [-1]}}
    first = mutant_tests.TestFile("tests/test_a.py", False, {"a::none": 1.0, "a::hit[0]": 2.0, "a::hit[1]": 1.0}, hit)
    slow = mutant_tests.TestFile("tests/test_a.py", True, {"a::slow": 9.0}, {module: {str(line): [0]}})
    second = mutant_tests.TestFile("tests/test_sums.py", False, {"b::hit": 3.0}, {module: {str(line): [0]}})
    third = mutant_tests.TestFile("tests/test_c.py", False, {"c::user": 1.0}, {other: {"5": [0]}})
    records = [slow, first, second, third]
    # the file with the module's name, one case of each test, other cases, those that do not execute the line, slow ones
    assert chosen(line) == ["b::hit", "a::hit[0]", "a::hit[1]", "a::none", "a::slow"]
    assert chosen(line, 4.0) == ["b::hit", "a::hit[0]"]
    # a constant belongs to all that execute functions of the module, or else to those of modules that import it
    assert chosen(line_of("LIMIT = 3"))[0] == "b::hit"
    records = [third]
    assert chosen(line_of("LIMIT = 3")) == ["c::user"]
    records = [third._replace(lines={})]
    assert chosen(line) == []


@pytest.mark.parametrize(
    ("status", "log", "expected"),
    [
        (0, [{"test": "a"}, {"test": "a", "failed": False}, {"test": "a", "ended": True}], ("survived", None)),
        (1, [{"test": "a"}, {"test": "a", "failed": True}, {"test": "a", "ended": True}], ("killed", "a")),
        (1, [{"test": "a"}, {"test": "a", "failed": False}], ("timeout", "a")),
        (None, [{"test": "a"}], ("timeout", "a")),
        (-11, [{"test": "a", "ended": True}, {"test": "b"}], ("crash", "b")),
        (2, [], ("killed", "collection")),
        (None, [], ("timeout", "collection")),
    ],
)
def test_verdict_tells_failures_from_ends_of_the_process(status, log, expected):
    assert mutants.verdict(mutant_tests.Ran(status, 1.0, log)) == expected


def test_verdict_of_wrong_usage_raises():
    with pytest.raises(Exception, match="status 4"):
        mutants.verdict(mutant_tests.Ran(4, 1.0, []))


# ---------------------------------------------------------------------------------------------------- a small checkout

LOOP = """
def halvings(number):
    count = 0
    while number > 1:
        number = number / 2
        count += 1
    return count


def untested(number):
    return number * 7
"""
TESTS = """
import pytest

from sidestep.tabular.loops import halvings, untested


def test_halvings():
    assert [halvings(n) for n in (1, 2, 4)] == [0, 1, 2]


@pytest.mark.slow
def test_untested():
    assert untested(2) == 14
"""


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A checkout with a package of two functions, one of which only a slow test calls."""
    monkeypatch.setenv("SIDESTEP_CACHE", str(tmp_path / "cache"))
    # the tests of a mutant import the small package, not this one
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(os.environ.get("PYTHONPATH", "").split(os.pathsep)[1:]))
    root = tmp_path / "checkout"
    files = {
        "src/sidestep/__init__.py": "",
        "src/sidestep/tabular/__init__.py": "",
        "src/sidestep/tabular/loops.py": LOOP,
        "tests/tabular/test_loops.py": TESTS,
        "pyproject.toml": '[tool.pytest.ini_options]\nmarkers = ["slow: slow"]\n',
    }
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(textwrap.dedent(text))
    return root


@pytest.mark.slow
def test_main_mutants_kills_what_is_tested_and_shows_the_rest(checkout, tmp_path, capsys):
    before = {path: path.read_bytes() for path in checkout.rglob("*") if path.is_file()}
    file = tmp_path / "records.json"
    common = ["mutants", "--root", str(checkout), "--packages", "tabular", "--mutants", "4", "--patience", "2"]
    assert main([*common, "--json", str(file)]) == 0
    records = json.loads(file.read_text())["records"]
    outcomes = {(record["line"], record["outcome"]) for record in records}
    tested, untested = range(2, 8), range(10, 12)
    assert {line for line, _ in outcomes} <= {*tested, *untested}
    assert {line for line, outcome in outcomes if outcome == "survived"} == {11}
    noticed = {record["test"] for record in records if record["line"] in tested}
    assert noticed == {"tests/tabular/test_loops.py::test_halvings"}
    printed = capsys.readouterr().out
    assert "return number" in printed
    assert "0." in printed
    # slow tests notice the others
    assert main([*common, "--slow", "--survivors", str(file), "--json", str(file)]) == 0
    again = json.loads(file.read_text())["records"]
    assert [record["line"] for record in again] == [11] * len(again)
    assert {(record["outcome"], record["slow"]) for record in again} == {("killed", True)}
    # the checkout is as it was
    assert {path: path.read_bytes() for path in checkout.rglob("*") if path.is_file()} == before
