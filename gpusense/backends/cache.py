"""Compiled OpenCL programs on disk, so that only the first run of a kernel on a device compiles it.

The folder is ``$GPUSENSE_CACHE_DIR``, else ``$XDG_CACHE_HOME/gpusense``, else ``~/.cache/gpusense``;
``GPUSENSE_CACHE=off`` switches it off. Entries are keyed by device, driver, options and source, are written by
rename, carry a checksum, and the oldest go when the folder holds more than it may. A cache that cannot be read or
written never stops a run. Warp and PoCL keep caches of their own in the same manner.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

from gpusense._version import __version__
from gpusense.backends.base import BackendInfo

MAX_BYTES = 256 << 20
MAX_ENTRIES = 512
_MAGIC = b"gpusense program 1\n"


def cache_folder() -> Path | None:
    """Folder of the cache, or None when it is switched off."""
    if os.environ.get("GPUSENSE_CACHE", "").lower() in ("off", "0", "false", "no"):
        return None
    if chosen := os.environ.get("GPUSENSE_CACHE_DIR"):
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gpusense"


class ProgramCache:
    """Programs of one device."""

    def __init__(self, info: BackendInfo) -> None:
        self._device = f"{info.backend}\n{info.name}\n{info.driver}\n{__version__}"

    def _path(self, source: str, options: Sequence[str]) -> Path | None:
        folder = cache_folder()
        if folder is None:
            return None
        text = "\0".join([self._device, *options, source])
        return folder / f"{hashlib.sha256(text.encode()).hexdigest()}.bin"

    def load(self, source: str, options: Sequence[str]) -> bytes | None:
        """The compiled program, or None where there is none or it is damaged."""
        path = self._path(source, options)
        if path is None:
            return None
        try:
            data = path.read_bytes()
            os.utime(path)
        except OSError:
            return None
        head, payload = data[: len(_MAGIC) + 32], data[len(_MAGIC) + 32 :]
        if head != _MAGIC + hashlib.sha256(payload).digest():
            self.discard(source, options)
            return None
        return payload

    def store(self, source: str, options: Sequence[str], payload: bytes) -> None:
        """Keep a compiled program; a folder that cannot be written is left alone."""
        path = self._path(source, options)
        if path is None or not payload:
            return
        try:
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
            try:
                with os.fdopen(handle, "wb") as file:
                    file.write(_MAGIC + hashlib.sha256(payload).digest() + payload)
                os.replace(temporary, path)
            except BaseException:
                os.unlink(temporary)
                raise
            _shrink(path.parent)
        except OSError:
            return

    def discard(self, source: str, options: Sequence[str]) -> None:
        """Drop an entry that turned out to be unusable."""
        path = self._path(source, options)
        if path is not None:
            try:
                path.unlink(missing_ok=True)
            except OSError:
                return


def _shrink(folder: Path) -> None:
    """Remove the least recently used entries beyond the bounds."""
    with os.scandir(folder) as found:
        entries = sorted(
            ((e.stat().st_mtime, e.stat().st_size, e.path) for e in found if e.name.endswith(".bin")), reverse=True
        )
    total = 0
    for number, (_, size, path) in enumerate(entries, 1):
        total += size
        if number > MAX_ENTRIES or total > MAX_BYTES:
            Path(path).unlink(missing_ok=True)
