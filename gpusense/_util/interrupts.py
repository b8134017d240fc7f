"""Interrupts in destructors, where Python would lose them as it ignores exceptions there."""

from __future__ import annotations

import _thread
import signal
import sys
import threading
import time
from collections.abc import Callable
from types import FrameType

# Delay after which the destructor has ended [s].
_LATER = 0.002
# Name of functions that are installed as ``sys.unraisablehook``.
HOOK = "report_unraisable"


def undisturbed(work: Callable[[], object]) -> None:
    """Run the work of a destructor to its end, and deliver an interrupt that came meanwhile after it.

    Args:
        work: A function that may be repeated, such as the wait for a device.
    """
    interrupt: KeyboardInterrupt | None = None
    while True:
        try:
            work()
            break
        except KeyboardInterrupt as error:
            interrupt = error
    if interrupt is not None:
        deliver_later(getattr(interrupt, "number", signal.SIGINT))


def deliver_later(number: int) -> None:
    """Send a signal to the main thread once it has left its destructor or the hook that reports errors in destructors.

    Python handles signals between bytecodes of the main thread, which may still be the destructor's.
    """
    # ``threading.Thread`` would wait for its start.
    _thread.start_new_thread(_deliver, (number,))


def _deliver(number: int) -> None:
    main = threading.main_thread().ident
    if main is None:
        return
    time.sleep(_LATER)
    while _is_lost_in(sys._current_frames().get(main)):
        time.sleep(_LATER)
    if sys.platform == "win32":
        _thread.interrupt_main(number)
    else:
        # Only a signal to the main thread interrupts the system call in which it may wait.
        signal.pthread_kill(main, number)


def _is_lost_in(frame: FrameType | None) -> bool:
    """Return whether an exception in a call would be ignored."""
    while frame is not None:
        if frame.f_code.co_name in ("__del__", HOOK):
            return True
        frame = frame.f_back
    return False
