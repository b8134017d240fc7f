"""Build the plan of any scan model: the notes on its scene, and the readings that its last call left out."""

from __future__ import annotations

from gpusense.interface.plan import Omission, Plan, SceneNotes, share
from gpusense.interface.signatures import KERNELS
from gpusense.models.scan.rules import ModelContext
from gpusense.models.scan.scoring import LastCall


def plan_of_call(notes: SceneNotes, context: ModelContext, last: LastCall) -> Plan:
    """Return the plan as of the last call."""
    device = context.backend.info
    title = f"{notes.title}, {device.selection} ({device.name})"
    if not context.rules.specialize:
        return Plan(f"{title}, specialize=False", last.flags, ())
    omissions = (*notes.omissions, *_arguments(last), *_launches(last), *_readings(last, context.rules.scanner.count))
    return Plan(title, last.flags, omissions, tuple(notes.kept), tuple(notes.could_go))


def _arguments(last: LastCall) -> list[Omission]:
    """Return the arguments that the kernels of the last call do not take."""
    rows = [KERNELS[kernel] for kernel in last.kernels]
    count = sum(len(row.arguments) for row in rows)
    absent = count - sum(len(row.with_flags(last.flags).arguments) for row in rows)
    if not absent:
        return []
    why = f"{absent} of {count} arguments belong to parts that are left out"
    return [Omission("kernel arguments", why, "their setting for each launch")]


def _launches(last: LastCall) -> list[Omission]:
    """Return the launches that scans share."""
    if last.together <= 1:
        return []
    saved = f"{last.together - 1} of {last.together} sets of launches"
    return [Omission("launches of single scans", f"{last.together} scans are scored together", saved)]


def _readings(last: LastCall, count: int) -> list[Omission]:
    """Return the readings of the last scan of ``count`` beams that are not evaluated; none before a call."""
    if last.scan is None:
        return []
    left_out = last.scan.left_out
    classes = (
        (left_out.missing, "missing readings", "say nothing"),
        (left_out.ignored_max, "max readings", "say nothing while z_max = 0"),
        (len(left_out.constant_max), "max readings", "have probability z_max at every pose"),
        (left_out.thinned, "thinned beams", "are not among those that beams= chose"),
    )
    return [
        Omission(what, f"{left} of {count} readings {why}", f"{share(left, count)} of the beams")
        for left, what, why in classes
        if left
    ]
