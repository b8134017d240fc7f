"""Interrupts that come where Python would lose them: exceptions in destructors are ignored."""

from __future__ import annotations

import _thread
import signal
import sys
import threading
import time
from collections.abc import Callable

# Until the destructor has ended [s].
_LATER = 0.002


def undisturbed(work: Callable[[], object]) -> None:
    """Run the work of a destructor to its end, and deliver an interrupt that came meanwhile after it.

    Args:
        work: May be repeated; it is the wait for a device.
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
    """Send a signal to the main thread shortly.

    Signals are handled between the lines of the main thread, which are those of the destructor still.
    """
    threading.Thread(target=_deliver, args=(number,), daemon=True).start()


def _deliver(number: int) -> None:
    time.sleep(_LATER)
    if sys.platform == "win32":
        _thread.interrupt_main(number)
    else:
        # Also where the main thread waits for the system, which a signal to another thread does not end.
        main = threading.main_thread().ident
        if main is not None:
            signal.pthread_kill(main, number)
