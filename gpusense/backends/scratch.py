"""A folder of this process for the compiled kernels of drivers, removed when the process ends.

Drivers do not check the files in their folders: a half-written or damaged file ends the run. Therefore every process
begins with an empty folder, and only files whose checksums hold are copied into it (see
:mod:`gpusense.backends.cache`). Only this user may change it. Its name, owner and lock file distinguish it from other
folders; those are never removed.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import mmap
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from gpusense._util.private import UnsafeFolderError, check_private, read_regular
from gpusense.backends import folders

_PREFIX = "gpusense-run-"
_NAME = re.compile(rf"{_PREFIX}[a-z0-9_]{{8}}")
_LOCK_FILE = "lock"
# Free space that is required [bytes]: for the kernels of a long run and the compiler's temporary files.
_NEEDED = 16 << 20
# Seconds after which a folder whose lock is free belongs to a process that was killed.
_STALE = 600


def scratch_folder(*, executable: bool = True) -> Path:
    """Return this process's folder.

    ``executable``: whether the system must allow code from there to run; some drivers only read the files.
    """
    if not executable:
        with contextlib.suppress(OSError):
            return _scratch(True)
    return _scratch(executable)


@functools.cache
def _scratch(executable: bool) -> Path:
    """Return the folder of this process; see :func:`scratch_folder`."""
    problems = []
    for name, find in _candidates():
        try:
            return _make(find(), executable=executable)
        except OSError as error:
            problems.append(f"{name} ({folders.reason_of(error)})")
    code = " and from which code may run" if executable else ""
    raise OSError(
        f"compiled kernels need a folder that takes {_NEEDED >> 20} MiB{code}, and there is none "
        f"among {', '.join(problems)}: set GPUSENSE_CACHE_DIR or TMPDIR to one"
    )


def _candidates() -> Iterator[tuple[str, Callable[[], Path]]]:
    """Yield folders in which to make this process's, the most suitable first: names, and functions that return them."""
    chosen, temporary = folders.chosen_place(), folders.temporary_place()
    if chosen is not None:
        yield f"{chosen.variable}: {chosen.folder}", functools.partial(_own_folder, chosen)
    if temporary is not None and (chosen is None or temporary.folder != chosen.folder):
        yield f"TMPDIR: {temporary.folder}", functools.partial(folders.private_folder, temporary.folder)
    for shared in ("/dev/shm", "/var/tmp"):
        if os.path.isdir(shared):
            yield shared, functools.partial(Path, os.path.realpath(shared))


def _own_folder(place: folders.Place) -> Path:
    """Return gpusense's folder in a place; report an unsafe place, where no compiled kernels are kept."""
    try:
        return folders.own_folder(place.folder)
    except UnsafeFolderError as error:
        folders.report(place, error)
        raise


def _make(parent: Path, *, executable: bool) -> Path:
    """Make a folder below ``parent`` that other processes do not remove while this one lives."""
    folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=parent))
    with contextlib.ExitStack() as failing:
        failing.callback(shutil.rmtree, folder, ignore_errors=True)
        check_private(folder)
        # Held open, and so locked, until the process ends.
        lock = failing.enter_context(open(folder / _LOCK_FILE, "xb"))
        with contextlib.suppress(OSError):
            _lock(lock)
        lock.write(_lock_text(folder.name))
        lock.flush()
        _check_room(folder, executable=executable)
        failing.pop_all()
    atexit.register(_remove, folder, os.getpid(), lock)
    _remove_stale(parent)
    return folder


def _lock_text(name: str) -> bytes:
    """Return the contents of the lock file of a process's folder."""
    return f"gpusense run folder 1\n{name}\n".encode()


def _lock(file: Any) -> None:
    """Lock a file until it is closed or this process ends."""
    try:
        import fcntl
    except ImportError:
        raise OSError("no locks of files here") from None
    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _check_room(folder: Path, *, executable: bool) -> None:
    """Write a file to check the room of a folder; the figures of a file system do not show quotas."""
    probe = folder / "probe"
    with open(probe, "w+b") as file:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, _NEEDED)
        else:
            file.write(bytes(1 << 20))
        if executable:
            _check_code(file.fileno())
    probe.unlink()


def _check_code(handle: int) -> None:
    """Map a page of a file as code, as loading a library does."""
    if not sys.platform.startswith("linux"):
        return
    try:
        mmap.mmap(handle, mmap.PAGESIZE, flags=mmap.MAP_PRIVATE, prot=mmap.PROT_READ | mmap.PROT_EXEC).close()
    except OSError as error:
        raise OSError(f"no code may run from there: {error.strerror}") from None


def _remove(folder: Path, process: int, lock: Any) -> None:
    """Remove the folder of this process; a forked child, which ends as well, leaves it."""
    if os.getpid() == process:
        lock.close()
        shutil.rmtree(folder, ignore_errors=True)


def _remove_stale(parent: Path) -> None:
    """Remove the folders of killed processes of this user."""
    with contextlib.suppress(OSError), os.scandir(parent) as listing:
        for entry in listing:
            if _NAME.fullmatch(entry.name):
                with contextlib.suppress(OSError):
                    _remove_killed(Path(entry.path))


def _remove_killed(folder: Path) -> None:
    """Remove the folder of a killed process: it is old and private, and its lock file is whole and free."""
    if time.time() - folder.lstat().st_mtime < _STALE:
        return
    check_private(folder)
    names, expected = os.listdir(folder), _lock_text(folder.name)
    if not names:
        # The process was killed before it made the lock file. This removes only an empty folder.
        folder.rmdir()
        return
    content = read_regular(folder / _LOCK_FILE, len(expected))
    if content != expected and not (names == [_LOCK_FILE] and expected.startswith(content)):
        return
    flags = os.O_RDWR | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    with os.fdopen(os.open(folder / _LOCK_FILE, flags), "r+b") as lock:
        _lock(lock)
        shutil.rmtree(folder, ignore_errors=True)
