"""The examples in docstrings, run on the installed package."""

import doctest
import importlib
import pkgutil
from pathlib import Path

import pytest

import sidestep


def modules_with_examples():
    for module in pkgutil.walk_packages(sidestep.__path__, "sidestep."):
        spec = module.module_finder.find_spec(module.name, None)  # pyright: ignore[reportCallIssue]
        if spec is not None and spec.origin is not None and ">>> " in Path(spec.origin).read_text():
            yield module.name


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(modules_with_examples()))
def test_doctest_of_module_runs_as_printed(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert not doctest.testmod(importlib.import_module(name), optionflags=doctest.ELLIPSIS).failed
