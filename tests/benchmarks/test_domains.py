"""Simulated domains, and the shapes of maps: small runs of both benchmarks, and banks of maps."""

import json

import numpy as np
import pytest
from benchmarks.__main__ import main

from benchmarks import domains, shapes
from sidestep.io.maps import write_map
from sidestep.tabular.grid import Grid


@pytest.mark.slow
def test_main_domains_writes_records_and_prints_a_row_a_domain(tmp_path, capsys):
    file, picture = tmp_path / "records.json", tmp_path / "reliability.png"
    size = ["--rows", "10", "--columns", "10", "--maps", "2", "--walks", "8", "--goals", "2"]
    options = ["--domains", "apartments", "blocks", "--methods", "behavior", "visits", "--set", "max_iterations=2"]
    assert main(["domains", *size, *options, "--json", str(file), "--picture", str(picture)]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    records = json.loads(file.read_text())["records"]
    assert [(r["domain"], r["draw"], r["method"]) for r in records[:4]] == [
        ("apartments", draw, method) for draw in (1, 2) for method in ("behavior", "visits")
    ]
    behavior, visits = records[0], records[1]
    assert sum(behavior["reliability"]["cells"]) == 100
    assert 0 < behavior["calibration_error"] < 1
    assert (visits["reliability"], visits["calibration_error"]) == (None, None)
    printed = capsys.readouterr().out
    assert "2 maps of 10×10, 2 goals, optimal agents" in printed
    assert printed.count("apartments") == printed.count("blocks") == 2


def test_coarsened_squares_are_occupied_if_any_cell_is_and_unknown_if_most_are():
    known = np.array([
        [1, 1, 1, 1, 1],
        [0, 0, -1, 0, 0],
        [0, 1, -1, -1, 0],
    ])  # fmt: skip
    grid = Grid(known, resolution=0.1, origin=(3.0, 4.0, 0.0))
    coarse = shapes.coarsened(grid, 2)
    assert coarse.known.tolist() == [[1, -1]]
    assert (coarse.resolution, coarse.origin) == (0.2, grid.origin)
    assert shapes.coarsened(grid, 1).known.tolist() == known.tolist()


def test_banks_leave_the_judged_mazes_out_and_repeat_small_kinds():
    small, large = Grid(np.zeros((2, 2), dtype=int)), Grid(np.zeros((4, 4), dtype=int))
    banks = shapes.banks({"few": [small], "many": [large, large], shapes.JUDGED: [small]})
    assert banks["development"] == [small, large, large]
    assert banks["kinds alike"] == 8 * [small] + [large, large]


@pytest.mark.slow
def test_main_shapes_prints_the_weights_of_each_kind(tmp_path, capsys):
    wall = np.zeros((6, 6))
    wall[1:5, 2] = 1
    for number in range(8):
        folder = tmp_path / f"maze_{number}"
        folder.mkdir()
        write_map(folder / "truth.yaml", wall, Grid(wall.astype(int)))
    file = tmp_path / "records.json"
    size = ["--count", "1", "--rows", "10", "--columns", "10", "--data", str(tmp_path), "--maps"]
    assert main(["shapes", *size, "--terms", "lines", "blocks", "--json", str(file)]) == 0
    records = {record["kind"]: record for record in json.loads(file.read_text())["records"]}
    assert list(records) == ["mazes 1–6", "mazes 7–12", *domains.DOMAINS, "development", "kinds alike"]
    mazes = records["mazes 1–6"]
    assert (mazes["maps"], mazes["cells"], mazes["occupied"]) == (6, 216, pytest.approx(4 / 36))
    assert mazes["lines"] > 0 > mazes["field"]
    assert (mazes["pairs"], mazes["isolated"]) == (0, 0)
    assert mazes["log_pseudolikelihood"] > mazes["independent"]
    assert "lines   blocks" in capsys.readouterr().out
