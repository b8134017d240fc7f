"""Find the files of a bag, and prepare files that the library rosbags cannot read.

A file that is cut off, comes with a journal, or lacks the suffix of its format is copied or linked into a temporary
folder that is deleted at the end of the process. The recording itself is never written.
"""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gpusense.logs.cut_bags import MCAP, ROS1, SQLITE, begins, mender_of

ZSTD = b"\x28\xb5\x2f\xfd"
_SUFFIXES = {MCAP: ".mcap", SQLITE: ".db3"}
# Suffixes of a database's journals of pages to add and of pages to restore, and first bytes of the latter in use.
_WAL, _ROLLBACK, _IN_USE = "-wal", "-journal", b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7"
_FOLDERS: list[Any] = []


def is_ros1(path: Path) -> bool:
    """Return whether a bag is one of ROS 1, by its first bytes, or by its suffix if they are of no kind of bag."""
    if path.is_dir() or any(begins(path, first) for first in (*_SUFFIXES, ZSTD)):
        return False
    return begins(path, ROS1) or path.suffix.lower() == ".bag"


def has_metadata(folder: Path) -> bool:
    """Return whether a folder has a ``metadata.yaml`` that is not empty."""
    file = folder / "metadata.yaml"
    return file.is_file() and file.stat().st_size > 0


def storage_files(folder: Path) -> list[Path]:
    """Return the files of a ROS 2 bag whose folder has no ``metadata.yaml``, by name.

    Raises:
        ValueError: They are compressed as a whole.
    """
    files = [file for file in sorted(folder.iterdir()) if file.is_file()]
    found = [file for file in files if any(begins(file, first) for first in _SUFFIXES)]
    if not found:
        packed = next((file for file in files if begins(file, ZSTD)), None)
        if packed is not None:
            raise ValueError(f"{packed}: must be decompressed in a folder without metadata.yaml, got a zstd file")
    return found


def is_bag_folder(folder: Path) -> bool:
    """Return whether a folder is a ROS 2 bag."""
    if (folder / "metadata.yaml").is_file():
        return True
    firsts = (*_SUFFIXES, ZSTD)
    return any(file.is_file() and any(begins(file, first) for first in firsts) for file in folder.iterdir())


def readable(path: Path) -> tuple[Path, bool]:
    """Return a bag that rosbags can read, and whether it has only the messages up to a cut.

    Args:
        path: A file of a bag, or a folder with ``metadata.yaml``.

    Raises:
        ValueError: The file is compressed as a whole.
    """
    files = sorted(path.iterdir()) if path.is_dir() else [path, *map(path.with_name, _journal_names(path))]
    stats = tuple((file, file.stat().st_size, file.stat().st_mtime_ns) for file in files if file.is_file())
    return _readable(path, stats)


@functools.lru_cache(maxsize=4)
def _readable(path: Path, stats: tuple[tuple[Path, int, int], ...]) -> tuple[Path, bool]:
    made: dict[Path, Callable[[Path], object]] = {}
    cut = False
    for file, size, _ in stats:
        if begins(file, SQLITE) and any(_holds_pages(file.with_name(name)) for name in _journal_names(file)):
            made[file] = functools.partial(_with_journal, file)
        elif (make := mender_of(file, size)) is not None:
            made[file], cut = make, True
    if path.is_file():
        if begins(path, ZSTD):
            rule = "must be decompressed, or replaced by the folder of its bag"
            raise ValueError(f"{path}: {rule}, got a file that is compressed as a whole")
        suffix = next((each for first, each in _SUFFIXES.items() if begins(path, first)), path.suffix)
        if not made and path.suffix == suffix:
            return path, False
        target = _folder() / (path.name if path.suffix == suffix else path.name + suffix)
        made.get(path, functools.partial(os.symlink, path.resolve()))(target)
        return target, cut
    if not made:
        return path, False
    target = _folder() / path.name
    target.mkdir()
    for file, _, _ in stats:
        made.get(file, functools.partial(os.symlink, file.resolve()))(target / file.name)
    return target, cut


def _folder() -> Path:
    """Make a folder that exists until the end of the process."""
    made = tempfile.TemporaryDirectory(prefix="gpusense-bag-")
    _FOLDERS.append(made)
    return Path(made.name)


def _journal_names(file: Path) -> tuple[str, str]:
    return file.name + _WAL, file.name + _ROLLBACK


def _holds_pages(journal: Path) -> bool:
    """Return whether a journal exists and has pages that its database lacks."""
    if not journal.is_file() or journal.stat().st_size == 0:
        return False
    return journal.name.endswith(_WAL) or begins(journal, _IN_USE)


def _with_journal(file: Path, out: Path) -> None:
    """Write a database with all its committed messages; SQLite applies the journal to a copy."""
    import sqlite3

    shutil.copyfile(file, out)
    for name, copied in zip(_journal_names(file), _journal_names(out), strict=True):
        if _holds_pages(file.with_name(name)):
            shutil.copyfile(file.with_name(name), out.with_name(copied))
    with contextlib.closing(sqlite3.connect(out)) as database:
        database.execute("PRAGMA trusted_schema = OFF")
        database.execute("SELECT count(*) FROM sqlite_master").fetchall()
        database.execute("PRAGMA journal_mode = DELETE")
