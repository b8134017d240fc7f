"""Compiled kernels and verdicts on drivers, kept on disk: only the first run on a device makes them.

The folder is ``$GPUSENSE_CACHE_DIR``, else ``$XDG_CACHE_HOME/gpusense``, else the system's place for caches:
``~/.cache/gpusense`` on Linux, ``~/Library/Caches/gpusense`` on macOS, and below ``%LOCALAPPDATA%`` on Windows.
``GPUSENSE_CACHE=off`` switches it off. An entry is one file that is named by a hash of its key, written by rename, and
begins with a checksum of its contents; the oldest go when the folder holds more than it may. Where the folder cannot be
written, a private temporary folder takes its place and one line of the log names it. A cache never stops a run.

PoCL and Warp keep compiled kernels in folders without checksums. Each process gives them an empty folder (see
:mod:`gpusense.backends.scratch`), and copies kernels there from entries, and new ones back into entries.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import io
import logging
import os
import stat
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

from gpusense._version import __version__
from gpusense.backends.info import BackendInfo
from gpusense.backends.processor import fingerprint

MAX_BYTES = 256 << 20
MAX_ENTRIES = 1024
_MAGIC = b"gpusense entry 2\n"
_HEAD = len(_MAGIC) + 32
_LOG = logging.getLogger("gpusense")
# Bytes, as most entries have.
_SMALL = 64 << 10
# Folders that do not take files.
_reported: set[str] = set()


def cache_folder() -> Path | None:
    """Return the folder of the cache, or None when it is switched off."""
    if os.environ.get("GPUSENSE_CACHE", "").lower() in ("off", "0", "false", "no"):
        return None
    if chosen := os.environ.get("GPUSENSE_CACHE_DIR"):
        return Path(chosen)
    if base := os.environ.get("XDG_CACHE_HOME"):
        return Path(base) / "gpusense"
    try:
        Path.home()
    except RuntimeError:
        # The user has no home folder.
        return temporary_folder()
    import platformdirs

    return platformdirs.user_cache_path("gpusense", appauthor=False)


def temporary_folder() -> Path | None:
    """Return this user's folder among temporary files, made where it is absent; None where it cannot be trusted."""
    try:
        folder = Path(tempfile.gettempdir()) / (f"gpusense-{os.getuid()}" if hasattr(os, "getuid") else "gpusense")
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError:
        return None
    # Kernels are code: the folder must be owned by this user and writable by this user only.
    is_owned = stat.S_ISDIR(status.st_mode) and (not hasattr(os, "getuid") or status.st_uid == os.getuid())
    return folder if is_owned and not status.st_mode & 0o022 else None


def _folders() -> Iterator[Path]:
    """Yield the chosen folder, and the temporary one where the chosen one does not take files."""
    chosen = cache_folder()
    if chosen is None:
        return
    yield chosen
    if str(chosen) in _reported or not _takes_files(str(chosen)):
        temporary = temporary_folder()
        if temporary is not None and temporary != chosen:
            yield temporary


@functools.lru_cache(maxsize=64)
def _takes_files(folder: str) -> bool:
    """Return whether a folder takes a small file; it is made where it is absent."""
    try:
        os.makedirs(folder, mode=0o700, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(_SMALL))
    except OSError as error:
        _report(folder, error)
        return False
    return True


def _report(folder: str, error: OSError) -> None:
    """Report once that a folder does not take files."""
    if folder not in _reported:
        _reported.add(folder)
        reason = error.strerror or type(error).__name__
        _LOG.warning("gpusense: the cache folder %s cannot be written: %s", folder, reason)


def _file(key: str) -> str:
    """Return the name of an entry's file."""
    return f"{hashlib.sha256(key.encode()).hexdigest()}.bin"


def load_entry(key: str) -> bytes | None:
    """Return the contents of an entry, or None where there is none; a damaged one is removed."""
    for folder in _folders():
        path = folder / _file(key)
        try:
            data = path.read_bytes()
        except OSError:
            continue
        if data[:_HEAD] == _MAGIC + hashlib.sha256(data[_HEAD:]).digest():
            # The least recently used entries are evicted first.
            with contextlib.suppress(OSError):
                os.utime(path)
            return data[_HEAD:]
        _remove(path)
    return None


def store_entry(key: str, payload: bytes) -> None:
    """Keep an entry where a folder takes it; a failure is reported once for each folder."""
    for folder in _folders():
        try:
            _write(folder, _file(key), _MAGIC + hashlib.sha256(payload).digest() + payload)
            return
        except OSError as error:
            _report(str(folder), error)


def discard_entry(key: str) -> None:
    """Remove an entry."""
    for folder in _folders():
        _remove(folder / _file(key))


def _write(folder: Path, name: str, data: bytes) -> None:
    """Write a file by rename, and evict others where the folder holds too much.

    Raises:
        OSError: the folder does not take it.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=folder, suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        os.replace(temporary, folder / name)
    except BaseException:
        _remove(Path(temporary))
        raise
    _shrink(folder)


def _remove(path: Path) -> None:
    """Remove a file, if that is possible."""
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)


def _shrink(folder: Path) -> None:
    """Evict the least recently used entries beyond the bounds, and the unfinished files of killed processes."""
    entries, begun = [], []
    with os.scandir(folder) as listing:
        for entry in listing:
            try:
                status = entry.stat(follow_symlinks=False)
            except OSError:
                # Another process has removed it.
                continue
            if entry.name.endswith(".bin"):
                entries.append((status.st_mtime, status.st_size, entry.path))
            elif entry.name.endswith(".tmp"):
                begun.append((status.st_mtime, entry.path))
    entries.sort(reverse=True)
    total, newest = 0, entries[0][0] if entries else 0.0
    for number, (_, size, path) in enumerate(entries, 1):
        total += size
        if number > MAX_ENTRIES or total > MAX_BYTES:
            _remove(Path(path))
    for changed, path in begun:
        if changed < newest - 3600:
            _remove(Path(path))


class ProgramCache:
    """Compiled programs of one device."""

    def __init__(self, info: BackendInfo) -> None:
        parts = ["program", info.backend, info.name, info.driver, __version__]
        # GPUs' programs are the same on every host.
        self._device = "\n".join([*parts, fingerprint() if info.kind == "cpu" else ""])

    def key(self, source: str, options: Sequence[str]) -> str:
        """Return the key of a program's entry."""
        return "\0".join([self._device, *options, source])

    def load(self, source: str, options: Sequence[str]) -> bytes | None:
        """Return the compiled program, or None where there is none or it is damaged."""
        return load_entry(self.key(source, options))

    def store(self, source: str, options: Sequence[str], payload: bytes) -> None:
        """Keep a compiled program."""
        if payload:
            store_entry(self.key(source, options), payload)

    def discard(self, source: str, options: Sequence[str]) -> None:
        """Remove a program that the driver refuses."""
        discard_entry(self.key(source, options))


def pack(files: dict[str, bytes]) -> bytes:
    """Return files, by their paths below some folder, as the contents of one entry."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name in sorted(files):
            # A fixed date, so that equal files make equal entries.
            archive.writestr(zipfile.ZipInfo(name), files[name], zipfile.ZIP_DEFLATED, 1)
    return stream.getvalue()


def unpack(payload: bytes) -> dict[str, bytes]:
    """Return the files of :func:`pack`.

    Raises:
        ValueError: a path leads out of the folder, or the contents are no packed files.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(payload)) as archive:
            names = archive.namelist()
            for name in names:
                if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
                    raise ValueError(f"entry: must hold paths below its folder, got {name!r}")
            return {name: archive.read(name) for name in names}
    except zipfile.BadZipFile as error:
        raise ValueError(f"entry: must hold packed files, got other contents ({error})") from None


def write_files(folder: Path, files: dict[str, bytes]) -> None:
    """Write files below a folder, each by rename.

    Raises:
        OSError: the folder does not take them.
    """
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        os.chmod(temporary, 0o700)
        os.replace(temporary, path)
