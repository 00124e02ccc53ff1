"""The same fit on one device, on several, and in several processes: one objective, one gradient, one map."""

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from helpers.spread import GOALS, WAYS, measured

PROGRAM = Path(__file__).parents[1] / "helpers" / "spread.py"
LIMIT = 240
"""After how many seconds children that have not ended are given up; on idle cores they take a tenth of that."""
SPREAD = {"4 devices": (1, 4), "2 processes with 2 devices each": (2, 2)}
"""How many processes, and how many devices each has."""


@pytest.mark.parametrize("way", SPREAD)
def test_the_same_fit_however_it_is_spread(tmp_path, way):
    """One test, so that the children run once."""
    processes, devices = SPREAD[way]
    run_children(tmp_path, processes, devices)
    for name in WAYS:
        found = [dict(np.load(tmp_path / f"{name}-{process}.npz")) for process in range(processes)]
        expected = measured(name, None)
        for own in found:
            assert own["devices"] == processes * devices
            check_objective(own, expected)
            check_fit(own, expected)
            check_resumed(own, to_the_last_bit=processes == 1)
        for other in found[1:]:
            for key, value in found[0].items():
                np.testing.assert_array_equal(other[key], value, err_msg=key)
        # one task a device at a time, as there is no memory for more, and all at once
        assert found[0]["batches"] == {"jacobi": 2, "ordered": 1}[name]
    if processes > 1:
        check_refusals([(tmp_path / f"refusal-{process}.txt").read_text() for process in range(processes)])


def check_objective(found, expected):
    """Parts and slope are those of one device."""
    np.testing.assert_allclose(found["parts"], expected["parts"], rtol=1e-9)
    largest = np.abs(expected["slope"]).max()
    np.testing.assert_allclose(found["slope"], expected["slope"], rtol=1e-9, atol=1e-9 * largest)


def check_fit(found, expected):
    """A fit of a few iterations ends where that on one device does, and knows of all tasks."""
    np.testing.assert_allclose(found["found"], expected["found"], rtol=1e-7)
    assert found["converged"].all()
    assert found["sweeps"].shape == (len(GOALS),)


def check_resumed(found, to_the_last_bit):
    """A fit that was interrupted ends where an uninterrupted one does; several processes solve anew what was solved."""
    np.testing.assert_allclose(found["resumed"], found["found"], rtol=0 if to_the_last_bit else 1e-5)


def check_refusals(said):
    """Processes that were given different walks all say so."""
    assert all("the same model, demonstrations, settings and checkpoint in all processes" in each for each in said), (
        said
    )


def run_children(out, processes, devices):
    """Runs the program in so many processes at once, and ends them all if one fails or takes too long."""
    flags = f"--xla_cpu_use_fusion_emitters=false --xla_force_host_platform_device_count={devices}"
    changes = {
        "XLA_FLAGS": flags,
        "JAX_PLATFORMS": "cpu",
        "JAX_ENABLE_X64": "1",
        "JAX_CPU_COLLECTIVES_IMPLEMENTATION": "gloo",
    }
    port = ["--port", str(free_port())] if processes > 1 else []
    logs = [(out / f"log-{process}.txt").open("w+") for process in range(processes)]
    children = [
        subprocess.Popen(
            [sys.executable, str(PROGRAM), str(out), *port, "--process", str(process)],
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
    said = "\n".join(Path(log.name).read_text() for log in logs)
    assert ends == [0] * processes, (
        f"children ended with {ends} (None: not within {LIMIT} s, or not before another failed)\n{said}"
    )


def ends_of(children):
    """How the children ended; None for those that had not when time was up, or when another had failed."""
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
