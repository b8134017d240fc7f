"""Switch pyopencl's caches off: a read-only folder or a damaged file would end the run.

pyopencl keeps code that sets kernels' arguments in a database, and programs in files, both without checksums. Programs
are kept by :mod:`gpusense.backends.cache`, and that code is made in a millisecond.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import sqlite3
import sys
import threading
from collections.abc import Iterator
from typing import Any

import pyopencl as cl

# True if pyopencl's caches are off; once it is imported it has no other switch.
_SWITCH = "_PYOPENCL_NO_CACHE"
_lock = threading.RLock()


def _open_database() -> None:
    """Import the module that opens the database; where that fails the caches are off for the whole process."""
    if getattr(cl, _SWITCH, True):
        return
    # An object whose construction failed reports that again when it is collected.
    hook, sys.unraisablehook = sys.unraisablehook, lambda *_: None
    try:
        importlib.import_module("pyopencl.invoker")
    except (ImportError, OSError, sqlite3.Error) as error:
        setattr(cl, _SWITCH, True)
        # Programs of gpusense are never kept there.
        logging.getLogger("gpusense").info("gpusense: pyopencl's cache cannot be used and is left out: %s", error)
        error.__traceback__ = None
    finally:
        sys.unraisablehook = hook


_open_database()


def new_kernel(program: Any, name: str) -> cl.Kernel:
    """Return a new kernel object of a program."""
    with without_caches():
        return cl.Kernel(program, name)


@contextlib.contextmanager
def without_caches() -> Iterator[None]:
    """Switch pyopencl's caches off, and restore them on leaving."""
    with _lock:
        before = getattr(cl, _SWITCH, None)
        if before is None:
            yield
            return
        setattr(cl, _SWITCH, True)
        try:
            yield
        finally:
            setattr(cl, _SWITCH, before)
