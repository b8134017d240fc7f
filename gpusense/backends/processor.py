"""The host: its instruction sets, its memory, and a fingerprint for code that is compiled for it."""

from __future__ import annotations

import functools
import hashlib
import os
import platform
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from concurrent.futures import Future, ThreadPoolExecutor

_CPUINFO = "/proc/cpuinfo"


@functools.cache
def instruction_sets() -> frozenset[str]:
    """Return the instruction sets of the processor by Linux's names, such as ``avx2``; empty on other systems."""
    return frozenset(_fields().get("flags", "").split())


@functools.cache
def fingerprint() -> str:
    """Return a text that differs between processors for which a compiler may make different code."""
    fields = _fields()
    names = ("vendor_id", "cpu family", "model", "model name", "stepping")
    parts = [platform.machine(), platform.processor(), *(fields.get(name, "") for name in names)]
    parts.append(" ".join(sorted(instruction_sets())))
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def host_memory() -> int:
    """Return the bytes of the host's memory; 4 GiB where the system does not say."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return 4 << 30


@functools.cache
def _fields() -> dict[str, str]:
    """Return the fields of the first processor in Linux's list."""
    try:
        with open(_CPUINFO, encoding="utf-8", errors="replace") as file:
            text = file.read(1 << 16)
    except OSError:
        return {}
    lines = (line.partition(":") for line in text.split("\n\n")[0].splitlines())
    return {name.strip(): value.strip() for name, _, value in lines}


# ---- threads that share the host's part of large work: launches on the processor, copies, and bounds of poses


# Prefix of the names of the threads. They never wait for a device.
HELPERS = "gpusense pieces"


@functools.cache
def threads() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@functools.cache
def pool(process: int) -> ThreadPoolExecutor:
    """Return the threads of a process, one fewer than it has processors: the calling thread also works."""
    # Calls of few particles, and most processes, need no threads.
    from concurrent.futures import ThreadPoolExecutor

    return ThreadPoolExecutor(max(threads() - 1, 1), HELPERS)


def finish(helpers: Sequence[Future[Any]]) -> None:
    """Cancel helpers that have not begun, and wait for running helpers even when interrupted."""
    if not helpers:
        return
    from concurrent.futures import wait

    interrupted: BaseException | None = None
    for helper in helpers:
        helper.cancel()
    while any(not helper.done() for helper in helpers):
        try:
            wait(helpers)
        except KeyboardInterrupt as error:
            interrupted = error
    if interrupted is not None:
        raise interrupted
