"""Examples in docstrings run and print the results that they show."""

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
    monkeypatch.chdir(tmp_path)  # examples write files
    result = doctest.testmod(importlib.import_module(name), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert result.attempted > 0
    assert result.failed == 0
