"""The folder of the cache on each system."""

from __future__ import annotations

import importlib

import platformdirs
import pytest

from gpusense.backends import folders


@pytest.mark.parametrize(
    "module, name, place",
    [
        ("unix", "Unix", "home/.cache/gpusense"),
        ("macos", "MacOS", "home/Library/Caches/gpusense"),
        ("windows", "Windows", "local/gpusense/Cache"),
    ],
)
def test_the_cache_is_where_the_system_has_caches(tmp_path, monkeypatch, module, name, place):
    for variable in ("GPUSENSE_CACHE_DIR", "GPUSENSE_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    system = importlib.import_module(f"platformdirs.{module}")
    if module == "windows":
        monkeypatch.setattr(system, "get_win_folder", lambda _: str(tmp_path / "local"))
    monkeypatch.setattr(platformdirs, "PlatformDirs", getattr(system, name))
    assert folders.chosen_place().folder == tmp_path / place
