"""Verdicts on devices: a child compiles and runs kernels of each family on a device before this process trusts it.

A compiler that does not know a processor aborts, hangs or makes wrong code in the process that calls it. Therefore a
child computes a small scene and compares it with NumPy, once for each combination of device, driver, processor and
version of gpusense. A family of kernels that fails is not used: lanes are replaced by narrower ones and then by scalar
kernels, float64 counts as absent, and a device whose scalar kernels fail is unusable. The verdict is kept in the cache,
and so are the programs that the child compiled; a hang is kept once it has happened twice. ``GPUSENSE_PROOF=off``
trusts every driver. If no child can be started, a device without a cached verdict is trusted, with an entry in the log.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import re
import threading
from dataclasses import dataclass
from typing import Any

from gpusense._util import notices
from gpusense._version import __version__
from gpusense.backends import probe_process
from gpusense.backends.base import BackendInfo
from gpusense.backends.cache import discard_entry, load_entry, store_entry
from gpusense.backends.processor import fingerprint

# Families of kernels.
SCALAR, FLOAT64, VECTORS = "scalar kernels", "float64 kernels", "kernels in vectors"
_PROVE = "gpusense.evaluation.proof:prove"
_LOG = logging.getLogger("gpusense")
_HANGS, _HUNG = re.compile(r"\bhangs?\b"), "\nhung"
# Remedies by the words of a failure.
_REMEDIES = (
    # These failures already name the remedy.
    (r"compiled kernels need a folder|PoCL was used before|needs a Turing GPU", ""),
    (
        r'"ld" doesn\'t exist|linker command failed',
        "install the linker ld (on Debian: apt-get install binutils), then run 'gpusense devices --prove'",
    ),
    (r"No space left|takes \d+ MiB", "free some space, or set GPUSENSE_CACHE_DIR to a folder with more"),
    (
        _HANGS,
        "set GPUSENSE_PROOF_SECONDS higher if the machine is slow, or choose another device with GPUSENSE_BACKEND",
    ),
)
_OTHERWISE = "update the driver, or choose another device with GPUSENSE_BACKEND (for example warp:cpu or numpy)"


@dataclass(frozen=True)
class DeviceCheck:
    """The families of kernels that a device runs correctly."""

    usable: bool  # whether models can run on it
    lanes: int  # lanes that were proved; 1 if only scalar kernels were
    float64: bool  # whether float64 kernels were proved
    reason: str = ""  # the failures, empty where nothing failed
    rate: float = 0.0  # calls of a scan per second, the rank of a device in its class; 0 if not measured
    # True if the failure is due to the state of the machine, without a proof; such a verdict is not cached.
    passing: bool = False


_lock = threading.Lock()
# A lock for each verdict, so that several devices are proved at once.
_locks: dict[str, threading.RLock] = {}
_known: dict[str, DeviceCheck] = {}


def trust(info: BackendInfo) -> DeviceCheck:
    """Return a verdict without proof: the driver has the abilities that it claims."""
    return DeviceCheck(True, info.lanes, info.float64)


def unusable(reason: str, *, passing: bool = False) -> DeviceCheck:
    """Return the verdict on a device that no model can run on."""
    return DeviceCheck(False, 1, False, reason, passing=passing)


def verdict_on(info: BackendInfo, *, setup: Any = None, anew: bool = False) -> DeviceCheck:
    """Return the cached verdict on a device; without one, or with ``anew``, a child's (prepared by ``setup``)."""
    if probe_process.is_off():
        return trust(info)
    key, obstacle = _key(info), probe_process.obstacle()
    with _lock:
        lock = _locks.setdefault(key, threading.RLock())
    with lock:
        if anew and not obstacle:
            _known.pop(key, None)
            discard_entry(key)
            discard_entry(key + _HUNG)
        verdict = _known.get(key) or _load(key)
        if verdict is None and obstacle:
            _LOG.info("gpusense: %s is trusted without a proof: %s", name_of(info), obstacle)
            verdict = trust(info)
        elif verdict is None:
            verdict, conclusive = _prove(info, setup)
            if conclusive and not _hangs_first(key, verdict):
                store_entry(key, json.dumps(dataclasses.asdict(verdict)).encode())
            if verdict.reason:
                notices.warn(summary(info, verdict))
        _known[key] = verdict
        return verdict


def awaits_child(info: BackendInfo) -> bool:
    """Return whether a verdict on a device takes a child."""
    if not probe_process.can_start():
        return False
    key = _key(info)
    return key not in _known and _load(key) is None


def _hangs_first(key: str, verdict: DeviceCheck) -> bool:
    """Return whether a device hangs for the first time, perhaps on a busy machine; the next process tries once more."""
    if not _HANGS.search(verdict.reason) or load_entry(key + _HUNG) is not None:
        return False
    store_entry(key + _HUNG, b"once")
    return True


def name_of(info: BackendInfo) -> str:
    """Return a device as messages name it."""
    return f"{info.selection} ({info.name}, {info.driver})"


def summary(info: BackendInfo, verdict: DeviceCheck) -> str:
    """Return the failures of a device and their consequence, in one line."""
    if not verdict.usable:
        return f"{name_of(info)} is unusable: {with_remedy(verdict.reason)}"
    return f"{name_of(info)}: {with_remedy(verdict.reason, ', and so these are not used')}"


def with_remedy(reason: str, consequence: str = "") -> str:
    """Return a failure with its consequence and the remedy, in one line; empty without a failure."""
    remedy = next((remedy for pattern, remedy in _REMEDIES if re.search(pattern, reason)), _OTHERWISE)
    return "; ".join(filter(None, (reason + consequence, remedy))) if reason else ""


def apply(info: BackendInfo, verdict: DeviceCheck) -> BackendInfo:
    """Return a device as the verdict leaves it."""
    return dataclasses.replace(info, lanes=verdict.lanes, float64=verdict.float64)


def _key(info: BackendInfo) -> str:
    return "\n".join(
        ["verdict", info.backend, info.name, info.driver, info.target, str(info.lanes), fingerprint(), __version__]
    )


def _load(key: str) -> DeviceCheck | None:
    """Return the cached verdict; None if it is absent or damaged."""
    payload = load_entry(key)
    if payload is None:
        return None
    try:
        return DeviceCheck(**json.loads(payload))
    except (TypeError, ValueError):
        return None


def _prove(info: BackendInfo, setup: Any) -> tuple[DeviceCheck, bool]:
    """Prove families of kernels in children until each is proved or dropped; return verdict, and whether to keep it."""
    failures: list[str] = []
    conclusive = True
    while True:
        outcome = probe_process.run({"do": _PROVE, "info": dataclasses.asdict(info), "setup": setup})
        if not outcome.started:
            notices.warn(f"{name_of(info)} is trusted without a proof: {outcome.failure}")
            return _verdict(info, failures, outcome), False
        failed, failure = _failure(outcome)
        if not failed:
            return _verdict(info, failures, outcome), conclusive
        conclusive &= outcome.conclusive and not probe_process.PASSING.search(failure)
        lanes = f" of {info.lanes}" if failed == VECTORS else ""
        failures.append(f"{failed}{lanes} {failure}")
        if failed == FLOAT64:
            info = dataclasses.replace(info, float64=False)
        elif failed == VECTORS:
            info = dataclasses.replace(info, lanes=8 if info.lanes > 8 else 1)
        else:
            return unusable("; ".join(failures)), conclusive


def _verdict(info: BackendInfo, failures: list[str], outcome: probe_process.Outcome) -> DeviceCheck:
    """Return the verdict on a device as it was proved."""
    rate = next((float(report["rate"]) for report in outcome.said if "rate" in report), 0.0)
    return DeviceCheck(True, info.lanes, info.float64, "; ".join(failures), rate)


def _failure(outcome: probe_process.Outcome) -> tuple[str, str]:
    """Return the family that failed and its failure in words; empty texts if none failed."""
    begun = ""
    for report in outcome.said:
        begun = str(report.get("begin", begun))
        if "wrong" in report:
            return begun, f"compute wrong numbers ({report['wrong']})"
        if report.get("end"):
            # All families are proved; some drivers crash when their process exits.
            return "", ""
    if outcome.failure:
        return begun or SCALAR, _verb(outcome.failure)
    return begun, "ended early" if begun else ""


def _verb(failure: str) -> str:
    """Return a child's failure as it reads after the name of a family."""
    for singular, plural in (("ends the process", "end the process"), ("hangs", "hang")):
        if failure.startswith(singular):
            return plural + failure[len(singular) :]
    return f"fail: {failure}"


def info_of(job: dict[str, Any]) -> BackendInfo:
    """Return the device that a child is to prove."""
    return BackendInfo(**job["info"])
