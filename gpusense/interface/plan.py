"""The scene plan: what a scene does not need, why, and what leaving it out saves.

A spec of flags says what code a kernel has; tuned numbers are arguments. Everything here follows from the scene:
parameters, scanner, map, the last scan and cloud. ``specialize=False`` keeps it all in, with the same numbers.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Omission:
    """One thing left out.

    Attributes:
        what: The part that a scene does not need.
        why: The reason, with the numbers that decide it.
        saves: What is not computed, stored or moved.
    """

    what: str
    why: str
    saves: str


@dataclass(frozen=True)
class Plan:
    """What a model computes and what it leaves out."""

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
    """A part as a percentage of the whole."""
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
    """What parameters, scanner and map make unnecessary, before any scan is seen.

    Args:
        components: (parameter, its weight, cost of its component per particle-beam).
        mount: The scanner's pose on the robot.
        unknown: Policy for unknown cells.
        outside: Policy for what lies outside the grid.
        precision: ``"float32"`` or ``"float64"``.
        ring: Whether a ring of cells stands for what is outside.
    """
    found = [Omission(f"{name[2:]} component", f"{name} = 0", cost) for name, weight, cost in components if not weight]
    if mount[:2] == (0.0, 0.0):
        found.append(Omission("mount", "the scanner sits at the robot's origin", "a rotation per particle"))
    found.append(
        Omission(
            "unknown branch",
            f"unknown cells are {unknown} by one rule, applied once to the map",
            "a test per cell step",
        )
    )
    if ring:
        why = f"a sentinel ring stands for what is outside ({outside})"
        found.append(Omission("bounds tests", why, "four comparisons per step"))
    if precision == "float32":
        found.append(
            Omission(
                "float64", "positions are split into cell and fraction in float64", "half the bytes and wide units"
            )
        )
    return found


def launch_omissions(code: frozenset[str], least_ordered: tuple[int, int] | None = None) -> list[Omission]:
    """What the cloud of the last call makes unnecessary; nothing before there is one.

    Args:
        code: The flags of the last call.
        least_ordered: Rays and particles from which a device puts the particles of a beam model in order; None for a
            device or a model that never does.
    """
    found = [ORDINARY_HEADINGS] if code and "HUGE_HEADINGS" not in code else []
    if "QUICK" in code:
        found.append(
            Omission(
                "guard of each end point",
                "cells are found by rounding, and again where one of 16 end points is near an edge",
                "a branch per particle-beam",
            )
        )
    if "INSIDE" in code:
        found.append(
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
        found.append(Omission("order of particles", why, "4 launches that sort by place and heading"))
    return found
