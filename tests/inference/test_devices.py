"""One device, several devices and several processes give the same objective, gradient and fit."""

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from helpers.spread import GOALS, measured

PROGRAM = Path(__file__).parents[1] / "helpers" / "spread.py"
LIMIT = 240
"""The time limit of child processes in seconds; on idle cores they take a tenth of it."""
SPREAD = {"4 devices": (1, 4, "jacobi"), "2 processes with 2 devices each": (2, 2, "gauss_seidel")}
"""The number of processes, of devices of each, and the solver."""


@pytest.mark.slow
@pytest.mark.parametrize("case", SPREAD)
def test_fit_over_devices_and_processes_equals_fit_on_one_device(tmp_path, case):
    """One test, so that the child processes run once."""
    processes, devices, name = SPREAD[case]
    expected = measured(name, None)  # first, so that native code is kept for the child processes
    run_children(tmp_path, processes, devices, name)
    results = [dict(np.load(tmp_path / f"{name}-{process}.npz")) for process in range(processes)]
    for own in results:
        assert own["devices"] == processes * devices
        check_objective(own, expected)
        check_fit(own, expected)
        check_resumed(own, bit_for_bit=processes == 1)
    for key, value in results[0].items():
        for other in results[1:]:
            np.testing.assert_array_equal(other[key], value, err_msg=key)
    # with the memory for all tasks, and for one per device
    assert results[0]["batches"] == {"jacobi": 1, "gauss_seidel": 2}[name]
    # processes with different demonstrations all raise
    refusals = [file.read_text() for file in tmp_path.glob("refusal-*.txt")]
    assert len(refusals) == (processes if processes > 1 else 0)
    expected = "the same model, demonstrations, settings and checkpoint in all processes"
    assert all(expected in message for message in refusals), refusals


def check_objective(result, expected):
    """The parts and the gradient are those of one device."""
    np.testing.assert_allclose(result["parts"], expected["parts"], rtol=1e-9)
    largest = np.abs(expected["gradient"]).max()
    np.testing.assert_allclose(result["gradient"], expected["gradient"], rtol=1e-9, atol=1e-9 * largest)


def check_fit(result, expected):
    """A short fit ends where that on one device does, and reports all tasks."""
    np.testing.assert_allclose(result["learned"], expected["learned"], rtol=1e-7)
    assert result["converged"].all()
    assert result["sweeps"].shape == (len(GOALS),)


def check_resumed(result, bit_for_bit):
    """A resumed fit ends where an uninterrupted one does; several processes start from cold starts."""
    np.testing.assert_allclose(result["resumed"], result["learned"], rtol=0 if bit_for_bit else 1e-5)


def run_children(out, processes, devices, name):
    """Run the program in several processes at once, and end them all if one fails or takes too long."""
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={devices}"
    changes = {
        "XLA_FLAGS": flags,
        "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": os.pathsep.join(filter(None, (str(PROGRAM.parents[1]), os.environ.get("PYTHONPATH")))),
        "JAX_ENABLE_X64": "1",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
        "JAX_CPU_COLLECTIVES_IMPLEMENTATION": "gloo",
    }
    port = ["--port", str(free_port())] if processes > 1 else []
    logs = [(out / f"log-{process}.txt").open("w+") for process in range(processes)]
    children = [
        subprocess.Popen(
            [sys.executable, str(PROGRAM), str(out), *port, "--process", str(process), "--name", name],
            env=os.environ | changes,
            stdout=log,
            stderr=subprocess.STDOUT,
        )
        for process, log in enumerate(logs)
    ]
    try:
        ends = ends_of(children)
    finally:
        for child in children:
            child.kill()
            child.wait()
        for log in logs:
            log.close()
    output = "\n".join(Path(log.name).read_text() for log in logs)
    assert ends == [0] * processes, (
        f"children ended with {ends} (None: not within {LIMIT} s, or not before another failed)\n{output}"
    )


def ends_of(children):
    """The exit codes of the children; None for those that had not ended in time, or before another failed."""
    until = time.monotonic() + LIMIT
    ends = [None] * len(children)
    while None in ends and not any(ends) and time.monotonic() < until:
        time.sleep(0.1)
        ends = [child.poll() for child in children]
    return ends


def free_port():
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        return listening.getsockname()[1]
