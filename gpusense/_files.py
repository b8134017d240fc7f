"""Files that are written whole or not at all."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO


def check_writable(path: Path) -> None:
    """See that a file can be written, leaving no trace.

    Raises:
        OSError: its folder is absent or does not take files.
        ValueError: something that is not a regular file has its name.
    """
    if os.path.lexists(path) and not path.is_file():
        raise ValueError(f"{path}: must be a regular file, got another kind")
    with _fresh(path) as stream:
        stream.write(b"\0")


def write_whole(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write a file so that it is there whole or, whatever happens, as it was before.

    Args:
        path: The file; it is replaced if it exists.
        write: Writes the contents to a binary stream.

    Raises:
        OSError, ValueError: as :func:`check_writable`, and what ``write`` raises.
    """
    # A link stays a link to the file that is replaced.
    target = Path(os.path.realpath(path))
    if os.path.lexists(target) and not target.is_file():
        raise ValueError(f"{path}: must be a regular file, got another kind")
    with _fresh(target) as stream:
        write(stream)
        stream.close()
        os.replace(stream.name, target)


@contextlib.contextmanager
def _fresh(path: Path) -> Iterator[BinaryIO]:
    """A new file in the folder of ``path``, gone in the end unless it was renamed."""
    fresh = path.parent / f".gpusense-{secrets.token_hex(6)}.new"
    try:
        with fresh.open("xb") as stream:
            yield stream
    except FileNotFoundError as error:
        raise FileNotFoundError(error.errno, error.strerror, str(path.parent)) from None
    finally:
        fresh.unlink(missing_ok=True)
