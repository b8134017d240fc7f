"""Fixtures of tests of caches and of the choice of a device."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest

from gpusense.backends import cache, scratch


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Use a private folder of temporary files, without earlier reports of failures."""
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    monkeypatch.setattr(scratch, "_reported", set())
    monkeypatch.setattr(cache, "_failed", set())
    cache._takes_files.cache_clear()
    return tmp_path / "tmp"


@pytest.fixture
def place(tmp_path: Path, temporary: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Use a private cache folder."""
    monkeypatch.setenv("GPUSENSE_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.delenv("GPUSENSE_CACHE", raising=False)
    return tmp_path / "cache"
