"""The process in which other planners run, in an environment of their own (`peer_planners.py`), seen from this side."""

import json
import os
import select
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from sidestep.errors import SidestepError

PLANNERS = Path(__file__).parent / "peer_planners.py"
BUILDING = 300.0
"""Seconds that a library may take to be imported and to build its matrices, which are not timed."""


class Peers:
    """The process in which the others run; one that takes longer than `patience` seconds to answer is replaced."""

    def __init__(self, python: str, patience: float):
        self._python, self._patience = python, patience
        self._folder = tempfile.TemporaryDirectory()
        self._values = Path(self._folder.name) / "values.npy"
        self._problem: Path | None = None
        self._process = self._begin()

    def _begin(self) -> subprocess.Popen:
        # threads that spin while they wait would slow themselves down on a machine that is shared
        surroundings = {**os.environ, "OMP_WAIT_POLICY": "passive"}
        return subprocess.Popen(
            [self._python, str(PLANNERS)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=surroundings,
        )

    def ask(self, patience: float | None = None, **request: Any) -> dict[str, Any]:
        """The answer; raises `SidestepError` for one that says what failed, or if there is none in time."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            self._process.stdin.write(json.dumps(request).encode() + b"\n")
            self._process.stdin.flush()
        except BrokenPipeError as error:
            raise SidestepError("the process of the others ended") from error
        if not select.select([self._process.stdout], [], [], patience or self._patience)[0]:
            self._process.kill()
            self._process.wait()
            self._process = self._begin()
            if self._problem:
                self.load(self._problem)
            raise SidestepError(f"over {patience or self._patience:g} s")
        line = self._process.stdout.readline()
        found = json.loads(line) if line else {"error": "the process of the others ended"}
        if "error" in found:
            raise SidestepError(found["error"])
        return found

    def load(self, problem: Path) -> None:
        """Has a problem read."""
        self._problem = problem
        self.ask(do="load", problem=str(problem))

    def solve(self, method: str, tolerance: float, horizon: int) -> tuple[float, np.ndarray]:
        """The seconds of a solve, and its values."""
        self.ask(patience=BUILDING, do="build", method=method)
        found = self.ask(do="solve", method=method, tolerance=tolerance, horizon=horizon, into=str(self._values))
        return found["seconds"], np.load(self._values)

    def close(self) -> None:
        """Ends the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(60)
        self._folder.cleanup()
