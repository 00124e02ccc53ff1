"""How many small mutations of the library's source code its tests notice.

Mutations are drawn at random in `tabular`, `inference` and `continuous`, as many in each: a place first, then one of
the mutations that cosmic-ray has for it (another operator or comparison, a number changed by one, a condition negated,
a sign or decorator deleted, a loop without rounds, another exception caught). Each is made in a copy of the checkout,
and tests of the package's folder, and those beside the folders, run until one fails: those that are not marked as slow,
or with `--slow` all (`mutant_tests` says which, and in which order). A mutant that ends the process is killed too, and
one under which a test takes more than ten times its time and a minute (`--patience`). `--budget` ends the tests of a
mutant early: it then counts as a survivor.

Left out is what cannot change a result: type annotations and types in calls, docstrings, texts (f-strings, arguments of
errors that are raised, `__repr__`), assertions, `TYPE_CHECKING`, decorators that compile, cache or declare, arguments
such as `strict` of `zip` or `unroll` (`mutations.WITHOUT_EFFECT`), and constants that decide how much is done at a time
(`mutations.SPEED_CONSTANTS`); and what fails wherever it runs: bits instead of arithmetic, `is` instead of `==`, `not`
instead of a sign. Mutants that are equal to the code for other reasons remain, such as `axis=1` instead of `axis=-1` in
arrays of two axes: no suite kills all.

Records: `package`, `file`, `line`, `operator`, `change` (lines that differ), `outcome` (`killed`, `timeout`, `crash`,
`survived`), `test` (which noticed it; `collection` where the tests could not be imported), `slow` (whether that test is
marked as slow), `tests` (how many were to run), `seconds`.
"""

import difflib
import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks import Record, groups, note, option, print_table
from benchmarks.mutant_tests import SOURCES, Chosen, Ran, TestFile, choose, recorded, run_tests, test_files
from benchmarks.mutations import Mutation, draw_mutations
from sidestep._cache import cache_folder
from sidestep._files import read_json
from sidestep.errors import check

PACKAGES = ("tabular", "inference", "continuous")
ROOT = Path(__file__).parents[1]
PARTS = ("src", "tests", "benchmarks", "docs", "examples")
"""The folders that are copied, with the files of the root."""
CODE = ("jax", "numba")
"""Folders of compiled code, which belongs to its content: a mutant finds there what it does not change."""
FACTOR = 10.0
"""A test of a mutant may take so many times its time, and `--patience` more."""
IMPORTING = 300.0
"""Seconds that a mutant's process may take beside its tests."""


@dataclass
class Options:
    """What to mutate."""

    mutants: int = option(90, "how many mutants in all", quick=3)
    packages: list[str] = option(list(PACKAGES), "the packages", quick=["inference"], choices=PACKAGES)
    seed: int = option(0, "the seed", least=0)
    slow: bool = option(False, "run tests that are marked as slow, too, after the others")
    budget: float = option(60.0, "seconds of the tests for a mutant, without the mutation", quick=10.0)
    patience: float = option(60.0, "seconds more than ten times its time that a test may take with a mutation")
    survivors: Path | None = option(None, "draw as before, but try only what survived in these records")
    root: Path = option(ROOT, "the checkout")


def measure(options: Options) -> Iterator[Record]:
    """Yield a record for each mutant, the packages in turns."""
    before = read_json(options.survivors)["records"] if options.survivors else None
    wanted = {_place(record) for record in before or () if record["outcome"] == "survived"}
    with TemporaryDirectory() as folder:
        checkout, code = Path(folder) / "checkout", Path(folder) / "code"
        copy_checkout(options.root, checkout)
        records = {package: _recorded(checkout, package, options.slow, Path(folder)) for package in options.packages}
        _copy_code(code)
        counts = [len(range(n, options.mutants, len(options.packages))) for n in range(len(options.packages))]
        draws = [
            draw_mutations(checkout / SOURCES, package, count, options.seed)
            for package, count in zip(options.packages, counts, strict=True)
            if count
        ]
        for package in options.packages:
            _check_without_mutation(checkout, records[package], code)
        for mutation in (each for turn in zip_longest(*draws) for each in turn if each is not None):
            package = Path(mutation.file).parts[0]
            record = {"package": package, "file": mutation.file, "line": mutation.line, "operator": mutation.operator}
            record["change"] = change(checkout, mutation)
            if before is None or _place(record) in wanted:
                record |= judged(checkout, mutation, records[package], options, code)
                note(f"{mutation.file}:{mutation.line} {record['outcome']} in {record['seconds']:.0f} s")
                yield record


def _place(record: Record) -> tuple[str, ...]:
    """Return what tells a mutant from others, wherever its lines have moved."""
    return record["file"], record["operator"], record["change"]


def copy_checkout(root: Path, into: Path) -> None:
    """Copy what the tests need of a checkout."""
    into.mkdir()
    for part in PARTS:
        if (root / part).exists():
            shutil.copytree(root / part, into / part, ignore=shutil.ignore_patterns("__pycache__"))
    for path in root.iterdir():
        if path.is_file():
            shutil.copy2(path, into)


def _recorded(checkout: Path, package: str, slow: bool, folder: Path) -> list[TestFile]:
    """Return what is noted of a package's tests; what they compile is kept for the next time."""
    own, kept = folder / "recording", cache_folder() or folder / "kept"
    own.mkdir(exist_ok=True)
    for name in CODE:
        (kept / name).mkdir(parents=True, exist_ok=True)
        if not (own / name).exists():
            (own / name).symlink_to(kept / name)
    return list(recorded(checkout, test_files(checkout, package), slow, kept / "mutants", own))


def _copy_code(into: Path) -> None:
    """Copy the compiled code that is kept: the mutants' own is dropped with the copy."""
    into.mkdir()
    folder = cache_folder()
    if folder is not None:
        for name in CODE:
            shutil.copytree(folder / name, into / name)


def _check_without_mutation(checkout: Path, records: Sequence[TestFile], code: Path) -> None:
    """Raise an error if tests fail without a mutation, for then all mutants would be killed."""
    quickest = min((each for each in records if each.seconds), key=lambda each: sum(each.seconds.values()))
    ran = _run(checkout, [Chosen(test, seconds, False) for test, seconds in quickest.seconds.items()], IMPORTING, code)
    check(ran.status == 0, f"{quickest.name} ends with status {ran.status} without a mutation", field="root")


def _run(checkout: Path, chosen: Sequence[Chosen], patience: float, code: Path) -> Ran:
    limits = {each.test: patience + FACTOR * each.seconds for each in chosen}
    files = dict.fromkeys(each.test.partition("::")[0] for each in chosen)
    total = IMPORTING + FACTOR * sum(each.seconds for each in chosen)
    return run_tests(checkout, files, limits, code, total, "-x")


def judged(checkout: Path, mutation: Mutation, records: Sequence[TestFile], options: Options, code: Path) -> Record:
    """Return how the tests of a mutant went."""
    chosen = choose(checkout, mutation.file, mutation.line, records, options.budget)
    if not chosen:
        return {"outcome": "survived", "test": None, "slow": None, "tests": 0, "seconds": 0.0}
    path = checkout / SOURCES / mutation.file
    source, stat = path.read_text(), path.stat()
    path.write_text(mutation.code)
    # Python takes compiled modules of the same size and second for those of the mutated file
    os.utime(path, (stat.st_atime, stat.st_mtime + 1 + _number(mutation.code)))
    try:
        ran = _run(checkout, chosen, options.patience, code)
    finally:
        path.write_text(source)
        os.utime(path, (stat.st_atime, stat.st_mtime))
    outcome, test = verdict(ran)
    slow = any(each.slow for each in chosen if each.test == test)
    return {"outcome": outcome, "test": test, "slow": slow, "tests": len(chosen), "seconds": ran.seconds}


def _number(code: str) -> int:
    """Return a number of seconds, another one for almost every text."""
    return hash(code) % 10**6


def verdict(ran: Ran) -> tuple[str, str | None]:
    """Return the outcome of a run of tests, and the test that decided it."""
    failed = next((line["test"] for line in ran.log if line.get("failed")), None)
    running = ran.log[-1]["test"] if ran.log and not ran.log[-1].get("ended") else None
    if ran.status == 0:
        return "survived", None
    if failed is not None:
        return "killed", failed
    if running is not None or ran.status is None:
        return "timeout" if ran.status in (None, 1) else "crash", running or "collection"
    check(ran.status in (1, 2, 3), f"pytest ended with status {ran.status}", field="root")
    return "killed", "collection"


def change(checkout: Path, mutation: Mutation) -> str:
    """Return the lines that differ, as in a diff."""
    before = (checkout / SOURCES / mutation.file).read_text().splitlines()
    lines = list(difflib.unified_diff(before, mutation.code.splitlines(), n=0, lineterm=""))[3:]
    return "\n".join(f"{line[0]} {line[1:].strip()}" for line in lines)


def show(records: Sequence[Record], options: Options) -> None:
    """Print the shares that are killed, and the survivors."""
    rows = [{**label, **_shares(own)} for label, own in groups(records, "package")]
    columns = {"package": "package", "mutants": "mutants", "killed": "killed", "by time or crash": "stopped"}
    columns |= {"survived": "survived", "share killed": "share .3f", "by tests not slow": "quick .3f"}
    columns |= {"seconds each": "seconds .1f"}
    print_table(f"mutants, seed {options.seed}", [*rows, {"package": "all", **_shares(records)}], columns)
    for record in records:
        if record["outcome"] == "survived":
            print(f"\n{record['file']}:{record['line']} {record['operator']}\n{record['change']}")


def _shares(records: Sequence[Record]) -> Record:
    killed = [record for record in records if record["outcome"] != "survived"]
    count = max(len(records), 1)
    return {
        "mutants": len(records),
        "killed": len(killed),
        "stopped": sum(record["outcome"] != "killed" for record in killed),
        "survived": len(records) - len(killed),
        "share": len(killed) / count,
        "quick": sum(not record["slow"] for record in killed) / count,
        "seconds": sum(record["seconds"] for record in records) / count,
    }
