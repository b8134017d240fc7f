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
