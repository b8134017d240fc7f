"""Find the free memory of this process, and check it before large allocations."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

_CGROUPS = (
    (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory.current")),
    (Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"), Path("/sys/fs/cgroup/memory/memory.usage_in_bytes")),
)


def available() -> int | None:
    """Return the free memory [bytes] of the machine, its container and this process's limit; None if unknown."""
    limits = [_machine(), _container(), _limit()]
    known = [size for size in limits if size is not None]
    return max(min(known), 0) if known else None


def check_room(name: str, needed: int, what: str) -> None:
    """Refuse work that needs more than the free memory [bytes], before it begins; ``what`` describes its contents."""
    room = available()
    if room is not None and needed > room:
        raise MemoryError(
            f"{name}: {what} must fit into the available memory, {_text(room)}, got {what} that need {_text(needed)}"
        )


def _text(size: int) -> str:
    return f"{size / 1e9:.3g} GB" if size >= 1e8 else f"{size / 1e6:.3g} MB"


def _machine() -> int | None:
    with contextlib.suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    with contextlib.suppress(OSError, ValueError, AttributeError):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_AVPHYS_PAGES")
    return None


def _container() -> int | None:
    """Return the memory left below a container's limit; reclaimable pages count as used."""
    for limit, usage in _CGROUPS:
        with contextlib.suppress(OSError, ValueError):
            return int(limit.read_text(encoding="ascii")) - int(usage.read_text(encoding="ascii"))
    return None


def _limit() -> int | None:
    """Return the memory left below the limit of this process's address space."""
    with contextlib.suppress(ImportError, OSError, ValueError, IndexError):
        import resource

        soft, _ = resource.getrlimit(resource.RLIMIT_AS)
        if soft != resource.RLIM_INFINITY:
            taken = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
            return soft - taken * resource.getpagesize()
    return None
