"""The Python and the commands in README.md and docs run, with small files.

The Python blocks of a page run in order as one program; a block of text right after one is what it prints. Of shell
blocks, commands that begin with `sidestep` run.
A block after `<!-- not run: REASON -->` is left out.
"""

import re
import shlex
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

import sidestep as ss
from sidestep.cli.app import main

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SLOW = re.compile("sidestep (demo|reproduce|experiment|compare)|--(person-column|goal-candidates|sensor-map)")
BLOCK = re.compile(
    r"(<!-- not run: [^>]+ -->\n+)?^```(python|sh)\n(.*?)^```\n(?:\n```text\n(.*?)^```)?", re.MULTILINE | re.DOTALL
)


class Snippet(NamedTuple):
    page: Path
    language: str
    line: int
    text: str
    printed: str | None


def snippets(language):
    for page in PAGES:
        text = page.read_text()
        for match in BLOCK.finditer(text):
            if match[2] == language and match[1] is None:
                yield Snippet(page, language, text[: match.start(3)].count("\n"), match[3], match[4])


def commands():
    for snippet in snippets("sh"):
        for line in snippet.text.replace("\\\n", " ").splitlines():
            if line.startswith("sidestep "):
                marks = [pytest.mark.slow] if SLOW.search(line) else []
                yield pytest.param(line, id=f"{snippet.page.name}: {line}", marks=marks)


def programs():
    for page, blocks in groupby(snippets("python"), lambda snippet: snippet.page):
        slow = [pytest.mark.slow] if page.name == "continuous.md" else []  # a fit by rollouts
        yield pytest.param(page, list(blocks), id=page.name, marks=slow)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory, datasets):
    """A folder with the files that the pages name: an office, its walks, and maps of it."""
    del datasets
    folder = tmp_path_factory.mktemp("inputs")
    cells = np.full((8, 8), int(ss.Cell.FREE))
    cells[3, :6] = ss.Cell.OCCUPIED  # a wall between start and goal of the README
    truth = ss.Grid(cells)
    blank = truth.forget()
    occupied = np.where(truth.known == ss.Cell.OCCUPIED, 0.6, 0.4)
    for name in ("true_office", "true", "truth"):
        ss.write_map(folder / f"{name}.yaml", (truth.known == ss.Cell.OCCUPIED).astype(float), truth)
    for name in ("office", "blank", "map"):
        ss.write_map(folder / f"{name}.yaml", occupied, blank)
    ss.write_map(folder / "seen.yaml", occupied, blank)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main(shlex.split("simulate true_office.yaml --out walks.csv --walks 12 --goals 2")) == 0
        walks = (folder / "walks.csv").read_text().splitlines()
        goals = {tuple(line.split(",")[-2:]) for line in walks[1:]}
        (folder / "goals.csv").write_text("goal_x,goal_y\n" + "".join(f"{x},{y}\n" for x, y in sorted(goals)))
        rows = [f"{line},{'ab'[int(line.split(',')[0]) % 2]}" for line in walks[1:]]
        (folder / "walks.csv").write_text("\n".join([f"{walks[0]},subject", *rows]) + "\n")
        yield folder


@pytest.mark.usefixtures("inputs")
@pytest.mark.parametrize("command", list(commands()))
def test_command_in_page_succeeds(command):
    assert main(shlex.split(command, comments=True)[1:]) == 0


@pytest.mark.usefixtures("inputs")
@pytest.mark.parametrize(("page", "blocks"), list(programs()))
def test_python_in_page_runs(page, blocks, capsys):
    namespace = {"__name__": page.stem}
    for block in blocks:
        exec(compile("\n" * block.line + block.text, str(page), "exec"), namespace)
        printed = capsys.readouterr().out
        assert block.printed is None or printed == block.printed
