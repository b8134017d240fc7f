"""Examples in docstrings run in separate namespaces and print the shown results."""

from __future__ import annotations

import doctest
import importlib
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
