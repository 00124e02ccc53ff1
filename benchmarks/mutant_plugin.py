"""A plugin of pytest for the tests of a mutant: their order, their time limits, and a log of how they went.

The environment variable `MUTANT_PLAN` names a file with `tests`, seconds by test in the order in which they run, and
`log`, the file that gets a line for each test that starts or ends. A test that takes longer ends the process, whatever
native code it is in. Where `tests` is null, there are no limits, and of the cases of a test those run that have a value
of a parameter that none before had; the log then begins with the names of all cases.
"""

import faulthandler
import json
import os
import resource
from pathlib import Path
from typing import Any

import pytest
from coverage import Coverage

MOST_BYTES = 16 * 2**30
"""The address space of a process: a mutant may ask for arrays of any size."""
_plan: dict[str, Any] = {}


def pytest_configure() -> None:
    """Read the plan."""
    _plan.update(json.loads(Path(os.environ["MUTANT_PLAN"]).read_text()))
    resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES))


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[Any]) -> None:
    """Leave the tests of the plan, in its order, or cases with each value of each parameter."""
    if _plan["tests"] is not None:
        own = {item.nodeid: item for item in items}
        items[:] = [own[test] for test in _plan["tests"] if test in own]
    else:
        _log({"collected": [item.nodeid for item in items]})
        seen: set[tuple[str, str]] = set()
        items[:] = [item for item in items if _has_new_value(item.nodeid, seen)]


def _has_new_value(test: str, seen: set[tuple[str, str]]) -> bool:
    function, _, case = test.partition("[")
    values = {(function, value) for value in case.split("-")}
    new = bool(values - seen)
    seen |= values
    return new


def pytest_runtest_logstart(nodeid: str) -> None:
    """Note that a test starts, and start its clock, or tell coverage.py which it is."""
    _log({"test": nodeid})
    if _plan["tests"] is not None:
        faulthandler.dump_traceback_later(_plan["tests"][nodeid], exit=True)
    elif (coverage := Coverage.current()) is not None:
        coverage.switch_context(nodeid)


def pytest_runtest_logreport(report: Any) -> None:
    """Note how a part of a test went."""
    _log({"test": report.nodeid, "seconds": report.duration, "failed": report.failed})


def pytest_runtest_logfinish(nodeid: str) -> None:
    """Stop the clock, and note that the test has ended."""
    faulthandler.cancel_dump_traceback_later()
    _log({"test": nodeid, "ended": True})


def _log(line: dict[str, Any]) -> None:
    with open(_plan["log"], "a") as file:
        file.write(json.dumps(line) + "\n")
