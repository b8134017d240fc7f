"""The scene plan: the parts of a computation that a scene does not need, the reasons, and the savings.

Flags choose the code of a kernel; tuned numbers are arguments. The plan follows from the scene: parameters, scanner,
map, and the last scan and cloud. ``specialize=False`` leaves nothing out and does not change results.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple


@dataclass(frozen=True)
class Omission:
    """A part that is left out.

    Attributes:
        what: The part that a scene does not need.
        why: The reason, with the numbers that decide it.
        saves: The saved computation, storage or copies.
        flags: Flags that the part would add to the scoring kernel.
        ends: Flags that the part would remove.
    """

    what: str
    why: str
    saves: str
    flags: frozenset[str] = frozenset()
    ends: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Note:
    """A part that is kept, or that another choice of the user would leave out."""

    what: str
    why: str


class SceneNotes(NamedTuple):
    """A title, and the parts that a scene leaves out, keeps, and could leave out."""

    title: str
    omissions: list[Omission]
    kept: list[Note]
    could_go: list[Note]


@dataclass(frozen=True)
class Plan:
    """The flags of a model's code, and the parts that are left out, kept, and removable.

    Attributes:
        title: The model and its device.
        code: Flags of the last call.
        omissions: The parts that are left out.
        kept: The parts that the scene needs, and why.
        could_go: Parts that another choice of the user would leave out.
        measured: Measured savings [s] by the name of the omission.
    """

    title: str
    code: frozenset[str]
    omissions: tuple[Omission, ...]
    kept: tuple[Note, ...] = ()
    could_go: tuple[Note, ...] = ()
    measured: Mapping[str, float] | None = None

    def __str__(self) -> str:
        lines = [self.title, f"code: {' '.join(sorted(self.code)) or 'plain'}"]
        if not self.omissions:
            lines.append("nothing is left out")
        names = [part.what for part in self.omissions] + [part.what for part in (*self.kept, *self.could_go)]
        width = max(map(len, names), default=0)
        lines += [f"- {o.what:<{width}}  {o.why}; saves {o.saves}{self.saving(o)}" for o in self.omissions]
        for heading, mark, parts in (("kept:", "+", self.kept), ("could go:", "?", self.could_go)):
            if parts:
                lines += [heading, *(f"{mark} {note.what:<{width}}  {note.why}" for note in parts)]
        return "\n".join(lines)

    def saving(self, omission: Omission) -> str:
        """Return the measured saving of an omission in words; empty without measurements."""
        if self.measured is None:
            return ""
        seconds = self.measured.get(omission.what)
        return "; not timed" if seconds is None else f"; measured {1e3 * seconds:+.3f} ms"


ORDINARY_HEADINGS = Omission(
    "reduction of huge headings", "no heading is beyond 2^20 rad", "192 bits of 2 / pi and 12 products per such heading"
)


def share(part: float, whole: float) -> str:
    """Return a part as a percentage of the whole."""
    return f"{100 * part / whole:.0f} %" if whole else "0 %"


def component_notes(components: Iterable[tuple[str, float, str]]) -> tuple[list[Omission], list[Note]]:
    """Return the omitted components of a mixture (weight 0), and the kept ones, from (weight's name, value, cost)."""
    omissions, kept = [], []
    for name, weight, cost in components:
        if weight:
            kept.append(Note(f"{name[2:]} component", f"{name} = {weight:g}"))
        else:
            flags = frozenset({name[2:].upper()}) if name != "z_max" else frozenset[str]()
            ends = frozenset({"SINGLE"}) if flags else flags
            omissions.append(Omission(f"{name[2:]} component", f"{name} = 0", cost, flags, ends))
    return omissions, kept


def precision_notes(precision: str) -> tuple[list[Note], list[Note]]:
    """Return the notes on precision: the kept one, and a lower one that the user could choose."""
    if precision == "float32":
        return [], []
    return [Note("float64", "precision='float64'")], [Note("float64", "precision='float32' needs half of the bytes")]


def launch_omissions(code: frozenset[str], least_ordered: tuple[int, int] | None = None) -> list[Omission]:
    """Return the parts that the cloud of the last call makes unnecessary; none before the first call.

    ``least_ordered``: rays and particles from which a beam model orders particles; None if it never does.
    """
    omissions = [ORDINARY_HEADINGS] if code and "HUGE_HEADINGS" not in code else []
    if code and "WORLDS" not in code:
        omissions.append(Omission("other worlds", "the model has a single map", "the map of each particle"))
    elif code and "SHAPES" not in code:
        omissions.append(Omission("moving shapes", "no world has shapes", "an intersection of each ray and shape"))
    if "ROUNDED_CELLS" in code:
        why = "cells are found by rounding, and again where one of 16 end points is near an edge"
        omissions.append(Omission("guard of each end point", why, "a branch per particle-beam"))
    if "INSIDE" in code:
        why = "no end point of the cloud leaves the table"
        omissions.append(Omission("clamps to the table", why, "four comparisons per particle-beam"))
    if code and least_ordered is not None and "ORDERED" not in code:
        rays, particles = least_ordered
        why = f"a launch has fewer than {rays} rays or {particles} particles"
        if "PER_BEAM" in code:
            why = "parts are wanted, particle by particle"
        omissions.append(Omission("order of particles", why, "4 launches that sort by place and heading"))
    return omissions
