"""Write files atomically."""

from __future__ import annotations

import atexit
import contextlib
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO, BinaryIO

# Unfinished files of this process: added before creation, removed after deletion.
_UNFINISHED: set[Path] = set()


@contextlib.contextmanager
def naming(path: object) -> Iterator[None]:
    """Name a file in errors of the operating system that lack a name, such as for a full disk."""
    try:
        yield
    except OSError as error:
        if error.filename is not None or error.strerror is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


def check_writable(path: Path) -> None:
    """Check that a file can be written, and leave no trace."""
    if os.path.lexists(path) and not path.is_file():
        raise ValueError(f"{path}: must be a regular file, got another kind")
    _write_fresh(path, lambda stream: stream.write(b"\0"), None)


def write_whole(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write a file atomically: it is complete or, after any failure, unchanged."""
    # Keep a symbolic link, and replace its target.
    target = Path(os.path.realpath(path))
    if os.path.lexists(target) and not target.is_file():
        raise ValueError(f"{path}: must be a regular file, got another kind")
    _write_fresh(target, write, target)


def write_several(writers: Mapping[Path, Callable[[BinaryIO], object]]) -> None:
    """Write several files atomically: all are replaced or, after any failure, none."""
    tag = _tag(4)
    fresh = {target: target.with_name(f".{target.name}.{tag}.new") for target in writers}
    backup = {target: target.with_name(f".{target.name}.{tag}.old") for target in writers}
    existed = {target: target.exists() for target in writers}
    replaced = False

    def clean() -> None:
        for target in writers:
            if not replaced and backup[target].exists():
                os.replace(backup[target], target)
            elif not replaced and not existed[target]:
                target.unlink(missing_ok=True)
            backup[target].unlink(missing_ok=True)
            _discard(fresh[target])

    # Twice: an interrupt may precede or end the first clean-up.
    try:
        try:
            for target, write in writers.items():
                _UNFINISHED.add(fresh[target])
                with naming(target), fresh[target].open("xb") as stream:
                    write(stream)
            for target in writers:
                if existed[target]:
                    os.replace(target, backup[target])
                os.replace(fresh[target], target)
            replaced = True
        finally:
            clean()
    finally:
        clean()


def _tag(size: int) -> str:
    """Return a random word of ``size`` bytes in hexadecimal digits."""
    # Imported on use, to keep imports fast.
    import secrets

    return secrets.token_hex(size)


def _write_fresh(path: Path, write: Callable[[BinaryIO], object], target: Path | None) -> None:
    """Write a new file in the folder of ``path``, and rename it to the target or delete it."""
    fresh = path.parent / f".gpusense-{_tag(6)}.new"
    # An interrupt may precede the first clean-up.
    try:
        try:
            _UNFINISHED.add(fresh)
            with naming(path), fresh.open("xb") as stream:
                write(stream)
            if target is not None:
                os.replace(fresh, target)
        except FileNotFoundError as error:
            raise FileNotFoundError(error.errno, error.strerror, str(path.parent)) from None
        finally:
            _discard(fresh)
    finally:
        _discard(fresh)


def _discard(fresh: Path) -> None:
    """Delete an unfinished file, if it exists."""
    fresh.unlink(missing_ok=True)
    _UNFINISHED.discard(fresh)


@atexit.register
def _remove_unfinished(process: int = os.getpid()) -> None:
    """Delete files left by repeated interrupts; a forked child keeps its parent's files."""
    for fresh in tuple(_UNFINISHED) if os.getpid() == process else ():
        with contextlib.suppress(OSError):
            _discard(fresh)


def unnamed_file() -> IO[bytes]:
    """Open an unnamed temporary file, in memory if no folder can hold it."""
    try:
        return tempfile.TemporaryFile()
    except OSError:
        if not hasattr(os, "memfd_create"):
            raise
        return os.fdopen(os.memfd_create("gpusense"), "w+b")
