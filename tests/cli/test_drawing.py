"""Pictures by a second process."""

import subprocess
import sys

import pytest

PROGRAM = """
from pathlib import Path
import sys

import pytest
import numpy as np
from sidestep.cli.drawing import draw, prepared_drawing
from sidestep.tabular.grid import Grid

with prepared_drawing():
    draw("figure_plan", Path("plan.png"), Grid.unknown(2, 2), np.full((2, 2), 0.5), np.array([0, 1])).result()
assert "matplotlib" not in sys.modules  # the second process has drawn
"""


@pytest.mark.slow
def test_draw_in_a_folder_with_a_file_named_like_a_module_does_not_run_it(tmp_path):
    (tmp_path / "matplotlib.py").write_text("open('was_run', 'w').close()")
    subprocess.run([sys.executable, "-P", "-c", PROGRAM], cwd=tmp_path, check=True)
    assert (tmp_path / "plan.png").stat().st_size > 0
    assert not (tmp_path / "was_run").exists()
