"""Warp, started without a word and with its own settings left as they are."""

from __future__ import annotations

import contextlib
import functools
import os
import tempfile
import threading
from collections.abc import Iterator
from typing import Any

import warp as wp

from gpusense.backends.cache import cache_folder

_NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"
# Guards Warp's settings, which belong to the process.
LOCK = threading.RLock()


@functools.cache
def initialize() -> None:
    """Start Warp without a word; that there is no CUDA driver is told by the list of devices."""
    with settings(), _filtered_stderr():
        wp.init()


@contextlib.contextmanager
def settings() -> Iterator[None]:
    """Warp without its greeting and progress, and without its cache where caches are off; then as it was before."""
    with LOCK, contextlib.ExitStack() as stack:
        if hasattr(wp.config, "log_level"):
            changed: dict[str, Any] = {"log_level": max(wp.config.log_level, wp.LOG_WARNING)}
        else:
            changed = {"quiet": True}
        if cache_folder() is None and wp.config.kernel_cache_dir is not None:
            folder = tempfile.TemporaryDirectory(prefix="gpusense_", ignore_cleanup_errors=True)
            changed |= {"cache_kernels": False, "kernel_cache_dir": stack.enter_context(folder)}
        before = {name: getattr(wp.config, name) for name in changed}
        try:
            for name, value in changed.items():
                setattr(wp.config, name, value)
            yield
        finally:
            for name, value in before.items():
                setattr(wp.config, name, value)


@contextlib.contextmanager
def _filtered_stderr() -> Iterator[None]:
    """Hold back what native code writes to standard error, and pass on all but the absence of a CUDA driver."""
    try:
        saved = os.dup(2)
    except OSError:
        yield
        return
    with tempfile.TemporaryFile() as held:
        os.dup2(held.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            held.seek(0)
            for line in held:
                if _NO_DRIVER not in line:
                    os.write(2, line)
