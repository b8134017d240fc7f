"""Compiled kernels and verdicts on drivers, kept on disk: only the first run on a device makes them.

Entries are in gpusense's folder (see :mod:`gpusense.backends.scratch`). An entry is one file that is named by a hash of
its key and written by rename. It begins with that hash and a checksum of hash and contents, so neither damage nor an
exchange of two files goes unnoticed. The oldest entries are evicted when the folder exceeds its limit; only a file with
the name and the head of an entry is deleted. If the folder is not safe or not writable, a private temporary folder
replaces it and one line of the log names it. A cache never stops a run.

PoCL and Warp keep compiled kernels in folders without checksums. Each process gives them an empty folder (see
:mod:`gpusense.backends.scratch`), and copies kernels there from entries, and new ones back into entries.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import hashlib
import io
import logging
import os
import re
import stat
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath

from gpusense._util.private import read_regular
from gpusense._version import __version__
from gpusense.backends import scratch
from gpusense.backends.base import BackendInfo
from gpusense.backends.processor import fingerprint
from gpusense.backends.scratch import Place

MAX_BYTES = 256 << 20
MAX_ENTRIES = 1024
# Largest size of an entry; the largest entry so far had 4 MiB.
MAX_ENTRY_BYTES = 64 << 20
_MAGIC = b"gpusense entry 3\n"
_DIGEST = hashlib.sha256().digest_size
# The magic, the hash of the key, and the checksum.
_HEAD = len(_MAGIC) + 2 * _DIGEST
_NAME = re.compile(r"([0-9a-f]{64})\.gpusense")
_UNFINISHED = re.compile(r"([0-9a-f]{64})-[a-z0-9_]{8}\.new")
# Typical size of an entry [bytes].
_SMALL = 64 << 10
# Seconds after which an unfinished file belongs to a process that was killed.
_STALE = 3600


def _folders() -> Iterator[tuple[Place, Path]]:
    """Yield the folder in the chosen place, then the temporary one in case no file can be written there."""
    chosen = scratch.chosen_place()
    if chosen is None:
        return
    temporary = scratch.temporary_place()
    for place in (chosen, temporary) if temporary is not None and temporary.folder != chosen.folder else (chosen,):
        try:
            folder = scratch.own_folder(place.folder)
        except OSError as error:
            scratch.report(place, error)
            continue
        yield place, folder
        if str(folder) not in _failed and _takes_files(place, folder):
            return


# Folders in which an entry could not be written.
_failed: set[str] = set()


@functools.lru_cache(maxsize=64)
def _takes_files(place: Place, folder: Path) -> bool:
    """Return whether a small file can be written in a folder."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(_SMALL))
    except OSError as error:
        scratch.report(place, error)
        return False
    return True


def _digest(key: str) -> bytes:
    return hashlib.sha256(key.encode()).digest()


def _file(key: str) -> str:
    """Return the name of an entry's file."""
    return f"{_digest(key).hex()}.gpusense"


def _head(digest: bytes, payload: bytes) -> bytes:
    """Return the head of an entry: the magic, the hash of its key, and the checksum."""
    return _MAGIC + digest + hashlib.sha256(digest + payload).digest()


def load_entry(key: str) -> bytes | None:
    """Return the contents of an entry; None if it is absent or damaged, or its file belongs to another user."""
    digest = _digest(key)
    for _, folder in _folders():
        try:
            # The least recently used entries are evicted first.
            data = read_regular(folder / _file(key), MAX_ENTRY_BYTES, touch=True)
        except OSError:
            continue
        payload = data[_HEAD:]
        if data[:_HEAD] == _head(digest, payload):
            return payload
    return None


def store_entry(key: str, payload: bytes) -> None:
    """Write an entry if a folder allows it; a failure is reported once for each folder."""
    if len(payload) > MAX_ENTRY_BYTES - _HEAD:
        return
    for place, folder in _folders():
        try:
            _write(folder, _file(key), _head(_digest(key), payload) + payload)
            return
        except OSError as error:
            _failed.add(str(folder))
            scratch.report(place, error)


def discard_entry(key: str) -> None:
    """Remove an entry."""
    for _, folder in _folders():
        _evict(folder / _file(key))


def _write(folder: Path, name: str, data: bytes) -> None:
    """Write an entry by rename, and evict old entries where the folder exceeds its limit."""
    with contextlib.suppress(FileNotFoundError):
        if not stat.S_ISREG(os.lstat(folder / name).st_mode):
            raise OSError(errno.EEXIST, f"{name} in it is no regular file")
    handle, temporary = tempfile.mkstemp(dir=folder, prefix=f"{name[:64]}-", suffix=".new")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        os.replace(temporary, folder / name)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        raise
    _shrink(folder)


def _evict(path: Path) -> None:
    """Remove a file that has the name and the head of an entry, complete or unfinished; leave all other files."""
    name = _NAME.fullmatch(path.name) or _UNFINISHED.fullmatch(path.name)
    if name is None:
        return
    with contextlib.suppress(OSError):
        expected = _MAGIC + bytes.fromhex(name[1])
        head = read_regular(path, MAX_ENTRY_BYTES, head=len(expected))
        # A process may be killed before it has written the head.
        if head == expected or (path.suffix == ".new" and expected.startswith(head)):
            path.unlink()


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
            if not stat.S_ISREG(status.st_mode):
                continue
            if _NAME.fullmatch(entry.name):
                entries.append((status.st_mtime, status.st_size, entry.path))
            elif _UNFINISHED.fullmatch(entry.name):
                begun.append((status.st_mtime, entry.path))
    entries.sort(reverse=True)
    total, newest = 0, entries[0][0] if entries else 0.0
    for number, (_, size, path) in enumerate(entries, 1):
        total += size
        if number > MAX_ENTRIES or total > MAX_BYTES:
            _evict(Path(path))
    for changed, path in begun:
        if changed < newest - _STALE:
            _evict(Path(path))


def program_key(info: BackendInfo, source: str, options: Sequence[str]) -> str:
    """Return the key of the entry of a program that is compiled for a device."""
    # Programs for GPUs do not depend on the host.
    host = fingerprint() if info.kind == "cpu" else ""
    device = "\n".join(["program", info.backend, info.name, info.driver, __version__, host])
    return "\0".join([device, *options, source])


# ---- files of a folder as the contents of one entry of the cache, and back


# Largest total size of the files of an entry.
_MOST_BYTES = 256 << 20


def pack(files: dict[str, bytes]) -> bytes:
    """Return files, by their paths below some folder, as the contents of one entry."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name in sorted(files):
            # A fixed date, so that equal files make equal entries.
            archive.writestr(zipfile.ZipInfo(name), files[name], zipfile.ZIP_DEFLATED, 1)
    return stream.getvalue()


def unpack(payload: bytes) -> dict[str, bytes]:
    """Return the files of :func:`pack`, whatever sizes the archive claims."""
    files, left = dict[str, bytes](), _MOST_BYTES
    try:
        with zipfile.ZipFile(io.BytesIO(payload)) as archive:
            for name in archive.namelist():
                with archive.open(name) as file:
                    files[name] = file.read(left + 1)
                left -= len(files[name])
                if left < 0:
                    break
    except (zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, RuntimeError, ValueError) as error:
        raise ValueError(f"entry: must hold packed files, got other contents ({error})") from None
    if left < 0:
        raise ValueError(f"entry: must hold at most {_MOST_BYTES} bytes of files, got more")
    for name in files:
        if not _is_below(name):
            raise ValueError(f"entry: must hold paths below its folder, got {name!r}")
    return files


def _is_below(name: str) -> bool:
    """Return whether a path leads to a place below a folder, on every system."""
    kinds = (PurePosixPath(name), PureWindowsPath(name))
    return not any(path.anchor or ".." in path.parts for path in kinds)


def write_files(folder: Path, files: dict[str, bytes]) -> None:
    """Write files below a folder, each by rename."""
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        os.chmod(temporary, 0o700)
        os.replace(temporary, path)


def restore_files(key: str, folder: Path) -> frozenset[str]:
    """Write the files of an entry below a folder, and return their paths in it; none without a usable entry."""
    payload = load_entry(key)
    if payload is None:
        return frozenset()
    try:
        files = unpack(payload)
        write_files(folder, files)
    except (OSError, ValueError) as error:
        logging.getLogger("gpusense").debug("compiled kernels were not restored: %s", error)
        return frozenset()
    return frozenset(files)


def store_files(key: str, folder: Path, names: frozenset[str]) -> bool:
    """Store files below a folder as an entry; return whether all can be read."""
    try:
        files = {name: (folder / name).read_bytes() for name in names}
    except OSError:
        return False
    store_entry(key, pack(files))
    return True
