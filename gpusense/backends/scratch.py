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
from typing import Any, NamedTuple

from gpusense._util import notices
from gpusense._util.private import UnsafeFolderError, check_private, make_private, read_regular

_PREFIX = "gpusense-run-"
_NAME = re.compile(rf"{_PREFIX}[a-z0-9_]{{8}}")
_LOCK_FILE = "lock"
# Free space that is required [bytes]: for the kernels of a long run and the compiler's temporary files.
_NEEDED = 16 << 20
# Seconds after which a folder whose lock is free belongs to a process that was killed.
_STALE = 600


def scratch_folder(*, executable: bool = True) -> Path:
    """Return this process's folder; ``executable``: whether code from there must be allowed to run."""
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
            problems.append(f"{name} ({reason_of(error)})")
    code = " and from which code may run" if executable else ""
    raise OSError(
        f"compiled kernels need a folder that takes {_NEEDED >> 20} MiB{code}, and there is none "
        f"among {', '.join(problems)}: set GPUSENSE_CACHE_DIR or TMPDIR to one"
    )


def _candidates() -> Iterator[tuple[str, Callable[[], Path]]]:
    """Yield folders in which to make this process's, the most suitable first: names, and functions that return them."""
    chosen, temporary = chosen_place(), temporary_place()
    if chosen is not None:
        yield f"{chosen.variable}: {chosen.folder}", functools.partial(_own_folder, chosen)
    if temporary is not None and (chosen is None or temporary.folder != chosen.folder):
        yield f"TMPDIR: {temporary.folder}", functools.partial(private_folder, temporary.folder)
    for shared in ("/dev/shm", "/var/tmp"):
        if os.path.isdir(shared):
            yield shared, functools.partial(Path, os.path.realpath(shared))


def _own_folder(place: Place) -> Path:
    """Return gpusense's folder in a place; report an unsafe place, where no compiled kernels are kept."""
    try:
        return own_folder(place.folder)
    except UnsafeFolderError as error:
        report(place, error)
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


# ---- folders for compiled kernels: a place that the user or the system chooses, and a folder of gpusense's in it
#
# The place is ``$GPUSENSE_CACHE_DIR``, else ``$XDG_CACHE_HOME/gpusense``, else the system's place for caches. It may
# hold files of other programs: gpusense reads, writes and deletes only in its folder ``gpusense-kernels``, identified
# by a marker file. Kernels are code: no other user may write in it or rename a folder above it.


OWN = "gpusense-kernels"
# The name and first line of the file that keeps a folder out of backups (https://bford.info/cachedir/).
MARKER = "CACHEDIR.TAG"
_MARKER_TEXT = (
    b"Signature: 8a477f597d28d172789f06886806bc55\n"
    b"# gpusense keeps compiled kernels in this folder, and deletes old ones. The folder may be removed.\n"
    b"# gpusense cache 3\n"
)
# The folders that were checked, for a user; no other user can change them afterwards.
_checked: set[tuple[str, int]] = set()
# Folders that have been reported.
_reported: set[str] = set()


class Place(NamedTuple):
    """Where a cache may be."""

    folder: Path
    variable: str  # the environment variable that it comes from


def chosen_place() -> Place | None:
    """Return the place of the cache, or None when it is switched off."""
    if os.environ.get("GPUSENSE_CACHE", "").lower() in ("off", "0", "false", "no"):
        return None
    if chosen := os.environ.get("GPUSENSE_CACHE_DIR"):
        return Place(Path(chosen), "GPUSENSE_CACHE_DIR")
    if base := os.environ.get("XDG_CACHE_HOME"):
        return Place(Path(base) / "gpusense", "XDG_CACHE_HOME")
    try:
        Path.home()
    except RuntimeError:
        # The user has no home folder.
        return temporary_place()
    import platformdirs

    variable = "LOCALAPPDATA" if os.name == "nt" else "HOME"
    return Place(platformdirs.user_cache_path("gpusense", appauthor=False), variable)


def temporary_place() -> Place | None:
    """Return this user's place among temporary files; None where the system has no folder for them."""
    try:
        return Place(Path(tempfile.gettempdir()) / f"gpusense-{_user()}", "TMPDIR")
    except OSError:
        return None


def own_folder(place: Path) -> Path:
    """Return gpusense's folder in a place, made if absent; UnsafeFolderError if others could change it or have it."""
    folder = Path(os.path.realpath(place)) / OWN
    key = str(folder), _user()
    if key not in _checked or not os.path.lexists(folder / MARKER):
        make_private(folder)
        _mark(folder)
        _checked.add(key)
    return folder


def private_folder(place: Path) -> Path:
    """Return a folder of this user alone, made if absent; UnsafeFolderError if another user could change it."""
    folder = Path(os.path.realpath(place.parent)) / place.name
    make_private(folder)
    return folder


def report(place: Place, error: OSError) -> None:
    """Report once that a place is not used or not writable."""
    if str(place.folder) not in _reported:
        _reported.add(str(place.folder))
        rule = reason_of(error)
        how = "is not used" if isinstance(error, UnsafeFolderError) else "cannot be written"
        notices.warn(f"the cache folder {place.folder} {how}: {rule} (the folder comes from {place.variable})")


def reason_of(error: OSError) -> str:
    """Return the reason of an error without its number and file name."""
    return error.strerror or str(error) or type(error).__name__


def _user() -> int:
    """Return the number of this user; 0 on systems that do not number them."""
    return os.geteuid() if hasattr(os, "geteuid") else 0


def _mark(folder: Path) -> None:
    """Write the marker of an empty folder; check that any other folder has it.

    This process may be killed, or another may look, between any two steps. Therefore files are written only after a
    complete marker, and a process that finds only an unfinished marker completes it.
    """
    if _marker(folder) == _MARKER_TEXT:
        return
    others = set(os.listdir(folder)) - {MARKER}
    begun = _marker(folder)
    if begun == _MARKER_TEXT:
        return
    if others or begun is None or not _MARKER_TEXT.startswith(begun):
        raise UnsafeFolderError(f"{folder} must be a folder that gpusense has made, got one without its {MARKER}")
    flags = sum(getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC", "O_BINARY"))
    handle = os.open(folder / MARKER, os.O_WRONLY | os.O_CREAT | flags, 0o600)
    try:
        # Every process writes the same bytes at the same place.
        os.write(handle, _MARKER_TEXT)
    finally:
        os.close(handle)


def _marker(folder: Path) -> bytes | None:
    """Return the contents of a folder's marker: empty without one, None if something else is in its place."""
    try:
        return read_regular(folder / MARKER, 4096)
    except FileNotFoundError:
        return b""
    except OSError:
        return None
