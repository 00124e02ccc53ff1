"""Which tests run for a mutant, and in which order.

Each test file runs once in a process of its own, under coverage.py, which notes the lines that each test executes; of
the cases of a test, as many as have each value of each parameter once. What a process compiled it does not trace again,
so a line of one test may matter to others of its file: a mutant is tried on all tests of the files that execute its
line, those first that did so themselves. Lines of native code, of functions that XLA calls and of constants are not
seen; they get the files that execute anything else in the module, or in the modules that import it. What was noted is
kept in the user's cache, and holds while the test file, what the tests share and the modules that they execute stay as
they were.
"""

import ast
import hashlib
import json
import os
import re
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import note
from sidestep._files import read_json, write_whole

PLUGIN = Path(__file__).parent / "mutant_plugin.py"
SOURCES = "src/sidestep"
RECORDING_LIMIT = 1800.0
"""Seconds that one test file may take under coverage."""


class TestFile(NamedTuple):
    """What was noted of the slow tests of a file, or of the others: seconds, and who executed each line of each module.

    Tests are numbered in the order of `seconds`; -1 stands for the file itself, while it is collected.
    """

    name: str
    slow: bool
    seconds: dict[str, float]
    lines: dict[str, dict[str, list[int]]]


class Chosen(NamedTuple):
    """A test for a mutant, its seconds without the mutation, and whether it is marked as slow."""

    test: str
    seconds: float
    slow: bool


class Ran(NamedTuple):
    """How a run of tests went: the exit status (None: it took too long), its seconds, and the plugin's log."""

    status: int | None
    seconds: float
    log: list[dict[str, Any]]


def run_tests(
    checkout: Path, files: Iterable[str], limits: dict[str, float] | None, cache: Path, limit: float, *options: str
) -> Ran:
    """Run test files of a checkout in a process of its own.

    Args:
        checkout: The root of a copy of the repository.
        files: The test files, by their paths from the root.
        limits: The seconds that each test may take, in the order in which they run; None for all tests, without limits.
        cache: The folder for compiled code, and for the plugin's files.
        limit: The seconds that all may take.
        *options: Further options of pytest.
    """
    plan, log = cache / "plan.json", cache / "log.jsonl"
    plan.write_text(json.dumps({"tests": limits, "log": str(log)}))
    log.write_text("")
    (cache / PLUGIN.name).write_text(PLUGIN.read_text())
    paths = os.pathsep.join(["src", str(cache), *os.environ.get("PYTHONPATH", "").split(os.pathsep)])
    added = {"PYTHONPATH": paths, "SIDESTEP_CACHE": str(cache), "MUTANT_PLAN": str(plan)}
    added["COVERAGE_FILE"] = str(cache / "coverage")
    command = [sys.executable, "-m", "pytest", "-q", "-p", PLUGIN.stem, "-p", "no:cacheprovider", *options, *files]
    started = time.perf_counter()
    try:
        done = subprocess.run(
            command, cwd=checkout, env=os.environ | added, timeout=limit, capture_output=True, check=False
        )
        status = done.returncode
    except subprocess.TimeoutExpired:
        status = None
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    return Ran(status, time.perf_counter() - started, lines)


# ---------------------------------------------------------------------------------------------------- recording


def test_files(checkout: Path, package: str) -> list[str]:
    """Return the test files of a package: those of its room, and those of no room."""
    tests = checkout / "tests"
    paths = [*sorted((tests / package).rglob("test_*.py")), *sorted(tests.glob("test_*.py"))]
    return [str(path.relative_to(checkout)) for path in paths]


def recorded(checkout: Path, names: Sequence[str], slow: bool, kept: Path, cache: Path) -> Iterator[TestFile]:
    """Yield what is noted of test files, and if they are asked for of their slow tests by themselves.

    Args:
        checkout: The root of a copy of the repository.
        names: The test files.
        slow: Whether tests that are marked as slow count.
        kept: The folder where what was noted is kept, and read while it holds.
        cache: The folder for compiled code.
    """
    for name, marked in [(name, marked) for marked in ((False, True) if slow else (False,)) for name in names]:
        path = kept / f"{name.replace('/', '-')}{'-slow' if marked else ''}.json"
        stored = read_json(path) if path.exists() else None
        if stored is None or stored["digests"] != {file: _digest(checkout / file) for file in stored["digests"]}:
            note(f"recording {name}{' (slow)' if marked else ''}")
            own = _record(checkout, name, marked, cache)
            shared = [*checkout.glob("tests/conftest.py"), *checkout.glob("tests/helpers/**/*.py")]
            files = [name, *(f"{SOURCES}/{file}" for file in own.lines), *(_name(file, checkout) for file in shared)]
            digests = {file: _digest(checkout / file) for file in files} | {str(PLUGIN): _digest(PLUGIN)}
            stored = {"digests": digests, **own._asdict()}
            text = json.dumps(stored).encode()
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, lambda file, text=text: file.write(text))
        yield TestFile(**{key: stored[key] for key in TestFile._fields})


def _name(path: Path, folder: Path) -> str:
    return str(path.relative_to(folder))


def _record(checkout: Path, name: str, slow: bool, cache: Path) -> TestFile:
    from coverage import CoverageData

    for program in (cache / "programs").glob("*"):
        program.unlink()  # a program that is kept is not traced
    # the path of the package, for the name imports it
    options = (f"--cov={SOURCES}", "--cov-report=", "-m", "slow" if slow else "not slow")
    ran = run_tests(checkout, [name], None, cache, RECORDING_LIMIT, *options)
    reports = [line for line in ran.log if "seconds" in line]
    failed = {line["test"] for line in reports if line["failed"]}
    seconds = dict.fromkeys((test for line in ran.log for test in line.get("collected", ()) if test not in failed), 0.0)
    for line in reports:
        if line["test"] not in failed:
            seconds[line["test"]] += line["seconds"]
    if ran.status not in (0, 5):
        note(f"warning: {name}: {len(failed)} tests fail without a mutation; they are left out (status {ran.status})")
    _fill(seconds, {line["test"] for line in reports})
    numbers = {test: number for number, test in enumerate(seconds)}
    data, lines = CoverageData(str(cache / "coverage")), {}
    data.read()
    for file in sorted(data.measured_files()):
        contexts = data.contexts_by_lineno(file)
        if contexts:
            module = _name(Path(file), (checkout / SOURCES).resolve())
            lines[module] = {
                str(line): sorted({numbers.get(each, -1) for each in own}) for line, own in sorted(contexts.items())
            }
    return TestFile(name, slow, seconds, lines)


def _fill(seconds: dict[str, float], ran: Collection[str]) -> None:
    """Give cases of tests that did not run the seconds of the longest that ran."""
    longest: dict[str, float] = defaultdict(float)
    for test, own in seconds.items():
        longest[test.partition("[")[0]] = max(own, longest[test.partition("[")[0]])
    for test in seconds.keys() - ran:
        seconds[test] = longest[test.partition("[")[0]]


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.exists() else ""


# ---------------------------------------------------------------------------------------------------- choosing


def choose(checkout: Path, file: str, line: int, records: Sequence[TestFile], budget: float) -> list[Chosen]:
    """Return tests that may notice a change of a line, those first that are most likely to do so soon.

    Tests that execute the line come before others of their files, quick ones before slow ones, one case of each test
    before the other cases, files that are named like the module before others, and then those that take less time.

    Args:
        checkout: The root of the repository.
        file: The module, by its path from the package.
        line: The line.
        records: What was noted of the test files.
        budget: The seconds of all tests together, without the mutation.
    """
    executed = _executed(checkout, file, line, records)
    ranked: list[tuple[tuple, Chosen]] = []
    for record, own in zip(records, executed, strict=True):
        if not own:
            continue
        named = Path(file).stem in record.name
        hits = [seconds for number, seconds in enumerate(record.seconds.values()) if number in own]
        total = sum(hits or record.seconds.values())
        cases: dict[str, int] = defaultdict(int)
        for number, (test, seconds) in enumerate(record.seconds.items()):
            function = test.partition("[")[0]
            key = record.slow, number not in own, cases[function] > 0, not named, total, record.name, seconds
            cases[function] += number in own or not hits
            ranked.append((key, Chosen(test, seconds, record.slow)))
    chosen, taken = [], 0.0
    for _, each in sorted(ranked, key=lambda pair: pair[0]):
        if taken <= budget:
            chosen.append(each)
            taken += each.seconds
    return chosen


def _executed(checkout: Path, file: str, line: int, records: Sequence[TestFile]) -> list[set[int]]:
    """Return the tests of each file that execute a line; of lines that are not seen, those of the module's others."""
    sources = checkout / SOURCES
    within = statement_lines((sources / file).read_text(), line)
    found = [_who(record, file, within or ()) for record in records]
    for modules in ((file,), importers(sources, file)):
        if not any(found):
            bodies = {module: body_lines((sources / module).read_text()) for module in modules}
            found = [set().union(*(_who(record, *body) for body in bodies.items())) for record in records]
    return found


def _who(record: TestFile, module: str, lines: Iterable[int]) -> set[int]:
    own = record.lines.get(module, {})
    return {test for line in lines for test in own.get(str(line), ())}


def statement_lines(source: str, line: int) -> range | None:
    """Return the lines of the statement in a function that a line belongs to; None outside of functions.

    A line above the body of a function belongs to the first statement of the body.
    """
    functions = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef)]
    around = [node for node in functions if _first(node) <= line <= (node.end_lineno or node.lineno)]
    if not around:
        return None
    function = max(around, key=lambda node: node.lineno)
    if line < function.body[0].lineno:
        return range(function.body[0].lineno, (function.end_lineno or 0) + 1)
    inner = [node for node in ast.walk(function) if isinstance(node, ast.stmt) and node is not function]
    own = max((node for node in inner if node.lineno <= line <= (node.end_lineno or 0)), key=lambda node: node.lineno)
    body = getattr(own, "body", None)
    return range(own.lineno, body[0].lineno if body and body[0].lineno > line else (own.end_lineno or 0) + 1)


def _first(function: ast.FunctionDef) -> int:
    return min([function.lineno, *(each.lineno for each in function.decorator_list)])


@cache
def body_lines(source: str) -> frozenset[int]:
    """Return the lines of the bodies of all functions."""
    functions = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef)]
    return frozenset(
        line for node in functions for line in range(node.body[0].lineno, (node.end_lineno or node.lineno) + 1)
    )


@cache
def importers(sources: Path, file: str) -> tuple[str, ...]:
    """Return the modules of the package that import a module by its name."""
    name = ".".join(["sidestep", *Path(file).with_suffix("").parts])
    pattern = re.compile(rf"^\s*(?:from|import) {re.escape(name)}\b", re.MULTILINE)
    paths = sorted(sources.rglob("*.py"))
    return tuple(str(path.relative_to(sources)) for path in paths if pattern.search(path.read_text()))
