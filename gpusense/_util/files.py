"""Write files atomically."""

from __future__ import annotations

import contextlib
import os
import secrets
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, BinaryIO


def check_writable(path: Path) -> None:
    """Check that a file can be written, and leave no trace.

    Raises:
        OSError: The folder is absent or not writable.
        ValueError: The path names something else than a regular file.
    """
    if os.path.lexists(path) and not path.is_file():
        raise ValueError(f"{path}: must be a regular file, got another kind")
    with _fresh(path) as stream:
        stream.write(b"\0")


def write_whole(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write a file atomically: it is either complete or, after any failure, as it was before.

    Args:
        path: The file; replaced if it exists.
        write: Function that writes the contents to a binary stream.

    Raises:
        OSError, ValueError: As in :func:`check_writable`, and all exceptions of ``write``.
    """
    # A symbolic link is kept; its target is replaced.
    target = Path(os.path.realpath(path))
    if os.path.lexists(target) and not target.is_file():
        raise ValueError(f"{path}: must be a regular file, got another kind")
    with _fresh(target) as stream:
        write(stream)
        stream.close()
        os.replace(stream.name, target)


@contextlib.contextmanager
def _fresh(path: Path) -> Iterator[BinaryIO]:
    """Open a new file in the folder of ``path``; delete it afterwards unless it was renamed."""
    fresh = path.parent / f".gpusense-{secrets.token_hex(6)}.new"
    try:
        with fresh.open("xb") as stream:
            yield stream
    except FileNotFoundError as error:
        raise FileNotFoundError(error.errno, error.strerror, str(path.parent)) from None
    finally:
        fresh.unlink(missing_ok=True)


def unnamed_file() -> IO[bytes]:
    """Open a temporary file without a name, in memory where no folder takes one.

    Raises:
        OSError: there is none.
    """
    try:
        return tempfile.TemporaryFile()
    except OSError:
        if not hasattr(os, "memfd_create"):
            raise
        return os.fdopen(os.memfd_create("gpusense"), "w+b")
