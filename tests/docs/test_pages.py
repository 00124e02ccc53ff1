"""What pages refer to exists: files, names, and a row of the glossary for every public name."""

import importlib
import re
from pathlib import Path
from types import FunctionType

import pytest

import sidestep as ss
import sidestep.continuous as sc

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), ROOT / "benchmarks" / "README.md"]
PATH = re.compile(r"`((?:src|tests|docs|benchmarks|examples)/[\w./]+\.(?:py|md|png))`")
LINK = re.compile(r"\]\((?!https?:)([^)#\s]+)(?:#[^)]*)?\)")
NAME = re.compile(r"`((?:ss|sc|sidestep)\.[\w.]+)")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_named_in_page_exist(page):
    text = page.read_text()
    missing = [path for path in PATH.findall(text) if not (ROOT / path).exists()]
    missing += [link for link in LINK.findall(text) if not (page.parent / link).exists()]
    assert not missing


@pytest.mark.parametrize("page", ["glossary.md", "equations.md"])
def test_names_in_page_exist(page):
    missing = []
    for name in NAME.findall((ROOT / "docs" / page).read_text()):
        try:
            resolve(name)
        except (ImportError, AttributeError):
            missing.append(name)
    assert not missing


def test_glossary_has_every_public_name():
    text = (ROOT / "docs" / "glossary.md").read_text()
    public = [f"ss.{name}" for name in dir(ss) if isinstance(getattr(ss, name), type | FunctionType)]
    public += [f"sc.{name}" for name in dir(sc)]
    assert not [name for name in public if f"`{name}`" not in text]


def resolve(name):
    first, *rest = name.split(".")
    value = {"ss": ss, "sc": sc, "sidestep": ss}[first]
    path = "sidestep"
    for part in rest:
        path = f"{path}.{part}"
        try:
            value = getattr(value, part)
        except AttributeError:
            value = importlib.import_module(path)
    return value
