"""Files of a folder as the contents of one entry of the cache, and back."""

from __future__ import annotations

import io
import os
import struct
import tempfile
import zipfile
import zlib
from pathlib import Path, PurePosixPath, PureWindowsPath

# Largest total size of the files of an entry.
_MOST_BYTES = 256 << 20


class RefusedError(ValueError):
    """Packed files that are intact but exceed a limit."""


def pack(files: dict[str, bytes]) -> bytes:
    """Return files, by their paths below some folder, as the contents of one entry."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name in sorted(files):
            # A fixed date, so that equal files make equal entries.
            archive.writestr(zipfile.ZipInfo(name), files[name], zipfile.ZIP_DEFLATED, 1)
    return stream.getvalue()


def unpack(payload: bytes) -> dict[str, bytes]:
    """Return the files of :func:`pack`."""
    try:
        with zipfile.ZipFile(io.BytesIO(payload)) as archive:
            for name in archive.namelist():
                if not _is_below(name):
                    raise RefusedError(f"entry: must hold paths below its folder, got {name!r}")
            return _read_all(archive)
    except RefusedError:
        raise
    except (zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, RuntimeError, ValueError) as error:
        raise ValueError(f"entry: must hold packed files, got other contents ({error})") from None


def _is_below(name: str) -> bool:
    """Return whether a path leads to a place below a folder, on every system."""
    kinds = (PurePosixPath(name), PureWindowsPath(name))
    return not any(path.anchor or ".." in path.parts for path in kinds)


def _read_all(archive: zipfile.ZipFile) -> dict[str, bytes]:
    """Return all files of an archive, whatever sizes it claims."""
    files, left = {}, _MOST_BYTES
    for name in archive.namelist():
        with archive.open(name) as file:
            files[name] = file.read(left + 1)
        left -= len(files[name])
        if left < 0:
            raise RefusedError(f"entry: must hold at most {_MOST_BYTES} bytes of files, got more")
    return files


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
