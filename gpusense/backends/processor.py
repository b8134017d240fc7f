"""The host: its instruction sets, its memory, and a fingerprint for code that is compiled for it."""

from __future__ import annotations

import functools
import hashlib
import os
import platform

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
