"""Examples in docstrings run in separate namespaces and print the shown results."""

from __future__ import annotations

import doctest
import importlib
import inspect
from collections.abc import Callable
from pathlib import Path

import pytest

import gpusense

FOLDER = Path(gpusense.__file__).parent


def modules_with_examples() -> list[str]:
    """Return the names of the package's modules with an example."""
    files = [path.relative_to(FOLDER.parent) for path in FOLDER.rglob("*.py") if ">>> " in path.read_text("utf-8")]
    return sorted(".".join(path.with_suffix("").parts).removesuffix(".__init__") for path in files)


@pytest.mark.parametrize("name", modules_with_examples())
def test_examples(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # Examples write files.
    attempted = 0
    for test in doctest.DocTestFinder(exclude_empty=True).find(importlib.import_module(name), globs={}):
        report: list[str] = []
        result = doctest.DocTestRunner(verbose=False, optionflags=doctest.NORMALIZE_WHITESPACE).run(
            test, out=report.append
        )
        assert result.failed == 0, "".join(report)
        attempted += result.attempted
    assert attempted > 0


def public_functions() -> dict[str, Callable[..., object]]:
    """Return the functions of gs and of its public modules by name."""
    spaces = {"": gpusense} | {name: getattr(gpusense, name) for name in ("plots", "worlds", "sweep", "compat")}
    return {
        f"{prefix}.{name}".lstrip("."): one
        for prefix, space in spaces.items()
        for name in space.__all__
        if inspect.isfunction(one := getattr(space, name))
    }


def test_public_functions_describe_their_arguments():
    functions = public_functions()
    assert len(functions) > 60 and "plots.save" in functions and "locate_scan" in functions
    taking = {name: one for name, one in functions.items() if inspect.signature(one).parameters}
    assert [name for name, one in taking.items() if "Args:" not in (one.__doc__ or "")] == []
