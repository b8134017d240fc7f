"""Describe the machine that a report is made on."""

from __future__ import annotations

import platform
from typing import Any

from gpusense._version import __version__


def machine() -> dict[str, Any]:
    """Return platform, processor, number of usable processors and versions, by name."""
    import numpy as np

    from gpusense.backends import processor

    return {
        "gpusense": __version__,
        "platform": platform.platform(),
        "processor": processor.name(),
        "processors": processor.threads(),
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
