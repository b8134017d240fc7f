"""The scene plan: the parts of a computation that a scene does not need, the reasons, and the savings.

Flags choose the code of a kernel; tuned numbers are arguments. The plan follows from the scene: parameters, scanner,
map, the last scan and cloud. With ``specialize=False`` nothing is left out, and results are the same.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Omission:
    """A part that is left out.

    Attributes:
        what: The part that a scene does not need.
        why: The reason, with the numbers that decide it.
        saves: The computation, storage or copies that are saved.
    """

    what: str
    why: str
    saves: str


@dataclass(frozen=True)
class Plan:
    """The code of a model, and the parts that it leaves out."""

    title: str
    code: frozenset[str]
    omissions: tuple[Omission, ...]

    def __str__(self) -> str:
        lines = [self.title, f"code: {' '.join(sorted(self.code)) or 'plain'}"]
        if not self.omissions:
            lines.append("nothing is left out")
        width = max((len(omission.what) for omission in self.omissions), default=0)
        lines += [f"- {o.what:<{width}}  {o.why}; saves {o.saves}" for o in self.omissions]
        return "\n".join(lines)


ORDINARY_HEADINGS = Omission(
    "reduction of huge headings", "no heading is beyond 2^20 rad", "192 bits of 2 / pi and 12 products per such heading"
)


def share(part: float, whole: float) -> str:
    """Return a part as a percentage of the whole."""
    return f"{100 * part / whole:.0f} %" if whole else "0 %"


def scene_omissions(
    *,
    components: Iterable[tuple[str, float, str]],
    mount: tuple[float, float, float],
    unknown: str,
    outside: str,
    precision: str,
    ring: bool = True,
) -> list[Omission]:
    """Return the parts that parameters, scanner and map make unnecessary, before any scan.

    Args:
        components: (parameter, its weight, cost of its component per particle-beam).
        mount: The scanner's pose on the robot.
        unknown: Policy for unknown cells.
        outside: Policy for the space outside the grid.
        precision: ``"float32"`` or ``"float64"``.
        ring: Whether a ring of cells around the grid stands for the space outside.
    """
    omissions = [
        Omission(f"{name[2:]} component", f"{name} = 0", cost) for name, weight, cost in components if not weight
    ]
    if mount[:2] == (0.0, 0.0):
        omissions.append(Omission("mount", "the scanner sits at the robot's origin", "a rotation per particle"))
    omissions.append(
        Omission(
            "unknown branch",
            f"unknown cells are {unknown} by one rule, applied once to the map",
            "a test per cell step",
        )
    )
    if ring:
        why = f"a sentinel ring stands for what is outside ({outside})"
        omissions.append(Omission("bounds tests", why, "four comparisons per step"))
    if precision == "float32":
        omissions.append(
            Omission(
                "float64", "positions are split into cell and fraction in float64", "half the bytes and wide units"
            )
        )
    return omissions


def launch_omissions(code: frozenset[str], least_ordered: tuple[int, int] | None = None) -> list[Omission]:
    """Return the parts that the cloud of the last call makes unnecessary; none before the first call.

    Args:
        code: The flags of the last call.
        least_ordered: Rays and particles from which the particles of a beam model are put in order; None where a device
            or a model puts none in order.
    """
    omissions = [ORDINARY_HEADINGS] if code and "HUGE_HEADINGS" not in code else []
    if "QUICK" in code:
        omissions.append(
            Omission(
                "guard of each end point",
                "cells are found by rounding, and again where one of 16 end points is near an edge",
                "a branch per particle-beam",
            )
        )
    if "INSIDE" in code:
        omissions.append(
            Omission(
                "clamps to the table",
                "no end point of the cloud leaves the table",
                "four comparisons per particle-beam",
            )
        )
    if code and least_ordered is not None and "ORDERED" not in code:
        rays, particles = least_ordered
        why = f"a launch has fewer than {rays} rays or {particles} particles"
        if "PER_BEAM" in code:
            why = "parts are wanted, particle by particle"
        omissions.append(Omission("order of particles", why, "4 launches that sort by place and heading"))
    return omissions
