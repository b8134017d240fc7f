"""Start Warp without output; change its settings, and restore them after each use."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import warp as wp

from gpusense._util.files import unnamed_file
from gpusense._version import __version__
from gpusense.backends.cache import restore_files, store_files
from gpusense.backends.processor import fingerprint
from gpusense.backends.scratch import scratch_folder

_NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"
# Guards Warp's settings, which belong to the process.
LOCK = threading.RLock()
_LOG = logging.getLogger("gpusense")


@functools.cache
def initialize() -> None:
    """Start Warp without its greeting and without its warning that there is no CUDA driver.

    Where Warp cannot make its folder of kernels, which would end the run, this process's folder is used.
    """
    with settings(kernels=False), _filtered_stderr():
        try:
            wp.init()
        except OSError as error:
            folder = _folder()
            # Kernels of gpusense are never kept there.
            _LOG.info("gpusense: Warp's own folder of kernels is %s, as it cannot be made: %s", folder, error)
            wp.config.kernel_cache_dir = str(folder)
            wp.init()


def _folder() -> Path:
    """Return this process's folder for Warp's kernels, which Warp reads and does not map as code."""
    folder = scratch_folder(executable=False) / "warp"
    folder.mkdir(exist_ok=True)
    return folder


def trouble() -> str:
    """Return why no kernel can be compiled; empty where one can."""
    try:
        _folder()
    except OSError as error:
        return str(error)
    return ""


@contextlib.contextmanager
def settings(*, kernels: bool = True) -> Iterator[None]:
    """Switch off Warp's greeting and progress and set this process's folder of kernels; restore everything on exit."""
    with LOCK:
        changed: dict[str, Any]
        if hasattr(wp.config, "log_level"):
            changed = {"log_level": max(wp.config.log_level, wp.LOG_WARNING)}
        else:
            changed = {"quiet": True}
        if kernels:
            changed["kernel_cache_dir"] = str(_folder())
        before = {name: getattr(wp.config, name) for name in changed}
        try:
            for name, value in changed.items():
                setattr(wp.config, name, value)
            yield
        finally:
            for name, value in before.items():
                setattr(wp.config, name, value)


def load(module: wp.Module, device: wp.Device, group: int) -> None:
    """Compile a module for a device, or take its code from the cache; within :func:`settings`."""
    name = module.get_module_identifier(block_dim=group)
    host = fingerprint() if device.is_cpu else f"{device.arch}"
    # The name holds a hash of the module's code.
    key = "\n".join(["warp", wp.__version__, __version__, device.name, host, name])
    restored = restore_files(key, _folder())
    wp.load_module(module, device=device, block_dim=group)
    files = frozenset(f"{name}/{path.name}" for path in (_folder() / name).glob("*") if path.is_file())
    if files - restored:
        store_files(key, _folder(), files)


@contextlib.contextmanager
def _filtered_stderr() -> Iterator[None]:
    """Filter the standard error of native code: the line on the absence of a CUDA driver is dropped."""
    with contextlib.ExitStack() as stack:
        try:
            output = stack.enter_context(unnamed_file())
            saved = os.dup(2)
        except OSError:
            yield
            return
        os.dup2(output.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            output.seek(0)
            for line in output:
                if _NO_DRIVER not in line:
                    os.write(2, line)
