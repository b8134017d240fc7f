"""Memory of processes, and sizes in bytes as strings."""

from __future__ import annotations

import os
import re
from importlib.util import find_spec

from gpusense._util import checks

_UNITS = {"": 1, "B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12,
          "KIB": 1 << 10, "MIB": 1 << 20, "GIB": 1 << 30, "TIB": 1 << 40}  # fmt: skip
_SIZE = re.compile(r"(\d{1,15}(?:\.\d{1,9})?) ?([A-Z]{0,3})")


def memory_of(process: int) -> int:
    """Return the resident memory of a process [bytes]; 0 if it has ended, or without psutil outside Linux."""
    if os.path.exists("/proc/self/statm"):
        try:
            with open(f"/proc/{process}/statm", "rb") as file:
                return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        except (OSError, ValueError, IndexError):
            return 0
    if find_spec("psutil") is None:
        return 0
    import psutil

    try:
        return int(psutil.Process(process).memory_info().rss)
    except psutil.Error:
        return 0


def shortages() -> int:
    """Return the number of processes that the system has ended for lack of memory, as far as it reports them."""
    try:
        with open("/proc/vmstat", "rb") as file:
            return next((int(line.split()[1]) for line in file if line.startswith(b"oom_kill ")), 0)
    except OSError:
        return 0


def size(name: str, text: str) -> int:
    """Return the number of bytes of a size such as "500 MB" or "4GiB".

    Raises:
        ValueError: ``text`` is no such size.
    """
    match = _SIZE.fullmatch(text.strip().upper())
    if match is None or match[2] not in _UNITS or float(match[1]) * _UNITS[match[2]] < 1:
        raise ValueError(f"{name}: must be a size such as 500MB or 4GiB, got {checks.show(text)}")
    return int(float(match[1]) * _UNITS[match[2]])


def size_text(count: int) -> str:
    """Format a number of bytes."""
    for unit in ("TB", "GB", "MB", "kB"):
        if count >= _UNITS[unit.upper()]:
            return f"{count / _UNITS[unit.upper()]:.4g} {unit}"
    return f"{count} B"
