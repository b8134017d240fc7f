"""Files that are written whole or not at all, and settings that are read from them."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from gpusense._util import checks

# Bytes: a file of settings is small.
_LARGEST_YAML = 1 << 20


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


def read_mapping(file: Path) -> dict[Any, Any]:
    """The mapping in a YAML file of plain values.

    Raises:
        ValueError: it is too large, no plain YAML, or no mapping.
    """
    import yaml

    with file.open("rb") as stream:
        text = stream.read(_LARGEST_YAML + 1)
    if len(text) > _LARGEST_YAML:
        raise ValueError(f"{file}: must be a YAML file of at most {_LARGEST_YAML} bytes, got a larger file")
    try:
        data = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        problem = getattr(error, "problem", None) or type(error).__name__
        mark = getattr(error, "problem_mark", None)
        where = f" in line {mark.line + 1}" if mark else ""
        raise ValueError(f"{file}: must be plain YAML, got an error{where}: {problem}") from error
    if not isinstance(data, dict):
        raise ValueError(f"{file}: must hold a YAML mapping, got {checks.show(data)}")
    return data
