"""Defer interrupts raised in destructors, where Python ignores exceptions."""

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
# Name of functions installed as ``sys.unraisablehook``.
HOOK = "report_unraisable"


def undisturbed(work: Callable[[], object]) -> None:
    """Run a destructor's repeatable work to its end, then raise any pending interrupt."""
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
    """Send a signal to the main thread once it has left a destructor, or the hook for errors in destructors.

    Python handles signals between bytecodes of the main thread, perhaps still in the destructor.
    """
    # ``threading.Thread`` would wait until it starts.
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
        # Only a signal to the main thread interrupts its system calls.
        signal.pthread_kill(main, number)


def _is_lost_in(frame: FrameType | None) -> bool:
    """Return whether Python would ignore an exception in a frame."""
    while frame is not None:
        if frame.f_code.co_name in ("__del__", HOOK):
            return True
        frame = frame.f_back
    return False
