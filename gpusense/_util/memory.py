"""Find the free memory of this process, check it before large allocations, and ask for large pages."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import mmap
import os
from collections.abc import Callable
from pathlib import Path

_CGROUPS = (
    (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory.current")),
    (Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"), Path("/sys/fs/cgroup/memory/memory.usage_in_bytes")),
)
_LARGE_PAGE = 1 << 21


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


def prefer_large_pages(address: int, size: int) -> None:
    """Ask the system for large pages behind memory that nothing has used yet.

    Reads all over a large table, as rays make them, otherwise wait for page tables: they take up to 1.7 times the time.
    """
    begin, end = -(-address // _LARGE_PAGE) * _LARGE_PAGE, (address + size) // _LARGE_PAGE * _LARGE_PAGE
    if end - begin >= _LARGE_PAGE and (advise := _advise()) is not None:
        advise(begin, end - begin, mmap.MADV_HUGEPAGE)


@functools.cache
def _advise() -> Callable[[int, int, int], int] | None:
    """Return Linux's madvise; None on other systems."""
    if not hasattr(mmap, "MADV_HUGEPAGE"):
        return None
    advise = ctypes.CDLL(None).madvise
    advise.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
    return advise


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
