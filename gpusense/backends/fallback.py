"""The devices among which ``"auto"`` chooses, the fastest first, and the devices that failed.

Each device is tried in turn: its library is loaded, its verdict is obtained, and it is opened. If a device fails, the
next slower one follows, and NumPy, which needs no driver, is the last. The failures are reported in one line.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from dataclasses import dataclass, field

from gpusense.backends import listing, proof
from gpusense.backends.listing import Device
from gpusense.backends.proof import DeviceCheck
from gpusense.backends.registry import BY_NAME, ENTRIES, SPEED_CLASSES, Entry

# Least speed ratio at which a device replaces an earlier device of its class.
NOTICED = 1.1
# The device that needs no driver.
_LAST = "numpy"


@dataclass(frozen=True)
class Failure:
    """A device that was passed over, or a backend without one."""

    selection: str  # its selection string; empty without one
    reason: str  # the reason, with the remedy
    line: str  # device and reason, as messages have them
    lasting: bool  # true if the reason is an earlier, already reported verdict


@dataclass
class FallbackOrder:
    """The usable devices, the fastest first."""

    failures: list[Failure] = field(default_factory=list)  # the devices that were passed over so far

    def __iter__(self) -> Iterator[Device]:
        """Yield devices; the library of a slower class is loaded only when needed."""
        waiting: list[Device] = []
        entries = sorted(ENTRIES, key=lambda one: one.best)
        while entries or waiting:
            best = best_of(waiting, self.failures)
            if entries and (best is None or BY_NAME[best.backend].speed[best.kind] >= entries[0].best):
                waiting += self._present(entries.pop(0))
            elif best is None:
                return
            else:
                waiting.remove(best)
                yield best

    def fail(self, device: Device, error: Exception) -> None:
        """Note that a device did not open."""
        reason = f"it does not open: {listing.one_line(error)}"
        self.failures.append(Failure(device.selection, reason, f"{_name_of(device)}: {reason}", False))

    def report(self, chosen: Device, held: list[str]) -> None:
        """Reduce the list of this choice's warnings to those to be shown, with one line about all failures.

        Where NumPy is chosen although faster backends are installed, every process prints this line, alone: NumPy
        compiles nothing, so other warnings mean nothing. Else a verdict is reported by the process that makes it.
        """
        if chosen.selection == _LAST:
            if self.failures:
                lines = "; ".join(failure.line for failure in self.failures)
                held[:] = [f"'auto' is numpy, as nothing faster works: {lines}"]
            return
        fresh = [one for one in self.failures if one.selection and (one.line in held or not one.lasting)]
        held[:] = [line for line in held if line not in {one.line for one in fresh}]
        if fresh:
            held.append(f"'auto' is {chosen.selection} ({chosen.name}): {'; '.join(one.line for one in fresh)}")

    def _present(self, entry: Entry) -> list[Device]:
        """Return the devices of a backend that may be chosen; note why an installed backend has none."""
        devices, absent = listing.present(entry)
        devices = [device for device in devices if device.kind != "simulator"]
        if not devices and importlib.util.find_spec(entry.package) is not None:
            for part in absent:
                self.failures.append(Failure("", part.reason, f"{part.name}: {part.reason}", True))
        return devices


def best_of(candidates: list[Device], failures: list[Failure] | None = None) -> Device | None:
    """Return the usable device of the fastest class; among several, the device that scores scans fastest.

    The rates were measured with the proofs. A device that is faster by less than ``NOTICED`` is not chosen, so that
    runs do not change between devices.

    ``candidates``: the devices; unusable ones are removed if ``failures`` is passed; ``failures``: receives the devices
    that are not usable.
    """
    for row in SPEED_CLASSES:
        best, most = None, 0.0
        for device in [one for one in candidates if (one.backend, one.kind) == row]:
            verdict = _verdict_of(device)
            if verdict.usable:
                if best is None or verdict.rate > NOTICED * most:
                    best, most = device, verdict.rate
            elif failures is not None:
                candidates.remove(device)
                reason = proof.with_remedy(verdict.reason, verdict.remedy)
                line = f"{_name_of(device)} is unusable: {reason}"
                failures.append(Failure(device.selection, reason, line, not verdict.passing))
        if best is not None:
            return best
    return None


def _name_of(device: Device) -> str:
    """Return a device as messages name it."""
    return f"{device.selection} ({device.name}, {device.driver})"


def _verdict_of(device: Device) -> DeviceCheck:
    """Return the verdict on a device that is present; a failure to obtain one is also a verdict."""
    library, info, handle = listing.lookup(device.selection)
    try:
        return listing.verdict_on(info, handle, library)
    except (OSError, RuntimeError) as error:
        return proof.unusable(listing.one_line(error), passing=True)
