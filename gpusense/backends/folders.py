"""Folders for compiled kernels: a place that the user or the system chooses, and a folder of gpusense's in it.

The place is ``$GPUSENSE_CACHE_DIR``, else ``$XDG_CACHE_HOME/gpusense``, else the system's place for caches:
``~/.cache/gpusense`` on Linux, ``~/Library/Caches/gpusense`` on macOS, and below ``%LOCALAPPDATA%`` on Windows.
``GPUSENSE_CACHE=off`` switches the cache off. A place may hold files of other programs: gpusense reads, writes and
deletes only in its folder ``gpusense-kernels``, identified by a marker file. Kernels are code, so it must be this
user's, and no other user may write in it or rename a folder above it, whatever variable chose the place.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import NamedTuple

from gpusense._util.private import UnsafeFolderError, make_private, read_regular
from gpusense.backends import notices

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
    """Return gpusense's folder in a place; make it where it is absent.

    Raises:
        UnsafeFolderError: Another user could change it, or it holds files and no marker.
        OSError: It cannot be made.
    """
    folder = Path(os.path.realpath(place)) / OWN
    key = str(folder), _user()
    if key not in _checked or not os.path.lexists(folder / MARKER):
        make_private(folder)
        _mark(folder)
        _checked.add(key)
    return folder


def private_folder(place: Path) -> Path:
    """Return a folder of this user alone, made where it is absent.

    Raises:
        UnsafeFolderError: Another user could change it.
        OSError: It cannot be made.
    """
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
