"""Write files atomically and read settings from YAML files."""

from __future__ import annotations

import contextlib
import functools
import os
import re
import secrets
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any, BinaryIO

from gpusense._util import checks

# A file of settings is small.
_LARGEST_YAML_BYTES = 1 << 20


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


@functools.cache
def _loader() -> Any:
    """Return PyYAML's safe loader with decimal numbers.

    YAML 1.1 reads 010 as octal and 1:30 as sexagesimal. ROS reads both with yaml-cpp, by YAML 1.2: ten, and no number.
    """
    import yaml

    class DecimalLoader(yaml.SafeLoader):
        pass

    def decimal(loader: Any, node: Any) -> Any:
        text = loader.construct_scalar(node)
        if ":" in text:
            return text
        if re.fullmatch("[-+]?0[0-9_]+", text):
            return int(text.replace("_", ""))
        construct = "construct_yaml_float" if node.tag.endswith("float") else "construct_yaml_int"
        return getattr(loader, construct)(node)

    # PyYAML takes 08 as text.
    DecimalLoader.add_implicit_resolver("tag:yaml.org,2002:int", re.compile("[-+]?0[0-9_]+$"), list("-+0"))
    for kind in ("int", "float"):
        DecimalLoader.add_constructor(f"tag:yaml.org,2002:{kind}", decimal)
    return DecimalLoader


def read_mapping(file: Path) -> dict[Any, Any]:
    """Read the mapping in a YAML file of plain values; numbers are decimal.

    Raises:
        ValueError: The file is too large, is not plain YAML, or holds no mapping.
    """
    import yaml

    with file.open("rb") as stream:
        text = stream.read(_LARGEST_YAML_BYTES + 1)
    if len(text) > _LARGEST_YAML_BYTES:
        raise ValueError(f"{file}: must be a YAML file of at most {_LARGEST_YAML_BYTES} bytes, got a larger file")
    try:
        data = yaml.load(text, _loader())
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        problem = getattr(error, "problem", None) or type(error).__name__
        mark = getattr(error, "problem_mark", None)
        line = f" in line {mark.line + 1}" if mark else ""
        raise ValueError(f"{file}: must be plain YAML, got an error{line}: {problem}") from error
    if not isinstance(data, dict):
        raise ValueError(f"{file}: must hold a YAML mapping, got {checks.show(data)}")
    return data
