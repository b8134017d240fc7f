"""Describe the machine that a report is made on."""

from __future__ import annotations

import contextlib
import os
import platform
import sys
from typing import Any

from gpusense._version import __version__


def machine() -> dict[str, Any]:
    """Return platform, processor, number of usable processors and versions, by name."""
    import numpy as np

    return {
        "gpusense": __version__,
        "platform": platform.platform(),
        "processor": processor_name(),
        "processors": _processors(),
        "python": f"{platform.python_implementation()} {platform.python_version()}",
        "numpy": np.__version__,
    }


def machine_line() -> str:
    """Format :func:`machine` as one line."""
    facts = machine()
    return (
        f"gpusense {facts['gpusense']}, {facts['processor']} ({facts['processors']} usable), {facts['platform']}, "
        f"{facts['python']}, NumPy {facts['numpy']}"
    )


def processor_name() -> str:
    """Return the processor's name as the operating system reports it."""
    for key in ("model name", "Model", "Hardware"):
        with contextlib.suppress(OSError), open("/proc/cpuinfo", encoding="utf-8", errors="replace") as lines:
            for line in lines:
                name, _, value = line.partition(":")
                if name.strip() == key and value.strip():
                    return value.strip()
    if sys.platform == "darwin":
        import subprocess

        with contextlib.suppress(OSError, subprocess.SubprocessError):
            command = ["/usr/sbin/sysctl", "-n", "machdep.cpu.brand_string"]
            return subprocess.run(command, capture_output=True, text=True, check=True, timeout=5).stdout.strip()
    return platform.processor() or platform.machine() or "unknown processor"


def _processors() -> int:
    """Count the processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
