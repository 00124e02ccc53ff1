"""A plugin of pytest for the tests of a mutant: their order, their time limits, and a log of how they went.

The environment variable `MUTANT_PLAN` names a file with `tests`, seconds by test in the order in which they run (null
for all, without limits), and `log`, the file that gets a line for each test that starts or ends. A test that takes
longer ends the process, whatever native code it is in.
"""

import faulthandler
import json
import os
import resource
from pathlib import Path
from typing import Any

MOST_BYTES = 16 * 2**30
"""The address space of a process: a mutant may ask for arrays of any size."""
_plan: dict[str, Any] = {}


def pytest_configure() -> None:
    """Read the plan."""
    _plan.update(json.loads(Path(os.environ["MUTANT_PLAN"]).read_text()))
    resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES))


def pytest_collection_modifyitems(items: list[Any]) -> None:
    """Leave the tests of the plan, in its order."""
    if _plan["tests"] is not None:
        own = {item.nodeid: item for item in items}
        items[:] = [own[test] for test in _plan["tests"] if test in own]


def pytest_runtest_logstart(nodeid: str) -> None:
    """Note that a test starts, and start its clock."""
    _log({"test": nodeid})
    if _plan["tests"] is not None:
        faulthandler.dump_traceback_later(_plan["tests"][nodeid], exit=True)


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
