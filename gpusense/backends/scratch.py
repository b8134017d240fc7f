"""A folder of this process for the compiled kernels of drivers, which is removed when the process ends.

Drivers do not check the files in their folders: one that another process left half-written, or that a disk has damaged,
ends the run. So every process begins with an empty folder, and only files whose checksums hold are copied into
it (see :mod:`gpusense.backends.cache`).
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from gpusense.backends.cache import cache_folder, temporary_folder

_PREFIX = "run-"
_LOCK_FILE = "lock"
# Bytes that must be free: kernels of a long run, with room for the compiler's own files.
_NEEDED = 16 << 20
# Seconds after which a folder whose lock is free belongs to a process that was killed.
_STALE = 600


@functools.cache
def scratch_folder() -> Path:
    """Return this process's folder.

    Raises:
        OSError: there is no folder that takes files and from which code may run.
    """
    problems = []
    for parent in _candidates():
        try:
            return _make(parent)
        except OSError as error:
            problems.append(f"{parent} ({error.strerror or error})")
    raise OSError(
        f"compiled kernels need a folder that takes {_NEEDED >> 20} MiB and from which code may run, and there is none "
        f"among {', '.join(problems)}: set GPUSENSE_CACHE_DIR or TMPDIR to one"
    )


def _candidates() -> Iterator[Path]:
    """Yield folders in which to make this process's, the most suitable first."""
    chosen = cache_folder()
    if chosen is not None:
        yield chosen
    temporary = temporary_folder()
    if temporary is not None and temporary != chosen:
        yield temporary
    for shared in ("/dev/shm", "/var/tmp"):
        if os.path.isdir(shared):
            yield Path(shared)


def _make(parent: Path) -> Path:
    """Make a folder below ``parent`` that other processes do not remove while this one lives.

    Raises:
        OSError: it takes no files, has too little room, or no code may run from it.
    """
    parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    if hasattr(os, "statvfs") and os.statvfs(parent).f_flag & getattr(os, "ST_NOEXEC", 0):
        raise OSError("no code may run from there")
    folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=parent))
    with contextlib.ExitStack() as failing:
        failing.callback(shutil.rmtree, folder, ignore_errors=True)
        # Held open, and so locked, until the process ends.
        lock = failing.enter_context(open(folder / _LOCK_FILE, "wb"))
        with contextlib.suppress(OSError):
            _lock(lock)
        _check_room(folder)
        failing.pop_all()
    atexit.register(_remove, folder, os.getpid(), lock)
    _remove_stale(parent)
    return folder


def _lock(file: Any) -> None:
    """Lock a file until it is closed or this process ends.

    Raises:
        OSError: another process has locked it, or the system has no such locks.
    """
    try:
        import fcntl
    except ImportError:
        raise OSError("no locks of files here") from None
    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _check_room(folder: Path) -> None:
    """Write a file to check the room of a folder; the figures of a file system do not show quotas.

    Raises:
        OSError: the folder does not take it.
    """
    probe = folder / "probe"
    with open(probe, "wb") as file:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, _NEEDED)
        else:
            file.write(bytes(1 << 20))
    probe.unlink()


def _remove(folder: Path, process: int, lock: Any) -> None:
    """Remove the folder of this process; a forked child, which ends as well, leaves it."""
    if os.getpid() == process:
        lock.close()
        shutil.rmtree(folder, ignore_errors=True)


def _remove_stale(parent: Path) -> None:
    """Remove the folders of killed processes: those with an unlocked lock file."""
    for folder in parent.glob(f"{_PREFIX}*"):
        try:
            if time.time() - folder.lstat().st_mtime < _STALE:
                continue
            with open(folder / _LOCK_FILE, "rb") as lock:
                _lock(lock)
                shutil.rmtree(folder, ignore_errors=True)
        except OSError:
            continue
