"""Unusable and usable folders of a cache."""

from __future__ import annotations

import os
from pathlib import Path

from gpusense.backends import scratch

BLOCKED = ["a file in its place", "a file above it", "a read-only system"]


def blocked(tmp_path: Path, how: str) -> Path:
    """Return a cache folder that no user can create or write."""
    if how == "a file in its place":
        (tmp_path / "file").write_text("not a folder")
        return tmp_path / "file"
    if how == "a file above it":
        (tmp_path / "file").write_text("not a folder")
        return tmp_path / "file" / "cache"
    # Not even root can write there.
    return Path("/proc/gpusense")


def entries_in(place: Path) -> list[Path]:
    """Return the sorted entries of the cache in a folder."""
    return sorted((place / scratch.OWN).glob("*.gpusense"))


def contents(folder: Path) -> dict[str, tuple[int, int]]:
    """Return all paths below a folder with mode and size."""
    found = {}
    for path in folder.rglob("*"):
        status = os.lstat(path)
        found[path.relative_to(folder).as_posix()] = (status.st_mode, status.st_size)
    return found
