"""Text and JSON of the stretches of a trajectory with the same verdict, for ``judge`` and ``localize``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from gpusense.commands.output import length, print_fact

if TYPE_CHECKING:
    from gpusense.evaluation.judging import Stretch

# Most stretches that are printed.
_MOST = 12


def print_stretches(stretches: Sequence[Stretch], begin: float, risk: float) -> None:
    """Print the stretches, the worst ones of many, by time since ``begin`` [s]."""
    order = {"lost": 0, "uncertain": 1, "tracking": 2}
    chosen = sorted(stretches, key=lambda one: (order[one.verdict], -one.duration))[:_MOST]
    for one in sorted(chosen, key=lambda one: one.first):
        print_fact(one.verdict, _summary(one, begin, risk))
        if one.place is not None:
            print_fact("", _place(one))
        if one.diagnosis is not None:
            print_fact("", one.diagnosis.text)
    if len(chosen) < len(stretches):
        print_fact("", f"and {len(stretches) - len(chosen)} shorter ones; --json lists all")


def _summary(one: Stretch, begin: float, risk: float) -> str:
    share, radius = "no beam to judge by", "no radius"
    if math.isfinite(one.explained):
        share = f"{100 * one.explained:.0f} % of the beams explained"
    if math.isfinite(one.radius):
        some = "" if one.promised == 1 else f" ({math.floor(100 * one.promised)} % of the scans)"
        radius = f"within {length(one.radius)} at risk {risk:g}{some}"
    return f"{one.start - begin:.1f} s to {one.end - begin:.1f} s: p_lost at most {one.p_lost:.2g}, {share}, {radius}"


def _place(one: Stretch) -> str:
    assert one.place is not None
    if one.place.status == "no match":
        return "no place of the map explains the scans"
    x, y, theta = one.place.pose.tolist()
    sure = "more likely at" if one.place.status == "found" else "among several places, likeliest at"
    return (
        f"{sure} x = {x:.2f}, y = {y:.2f}, theta = {theta:.2f} (p_right {one.place.p_right:.2g}), {one.off:.1f} m off"
    )


def stretch_rows(stretches: Sequence[Stretch]) -> list[dict[str, Any]]:
    """Return the stretches as JSON documents."""
    rows = []
    for one in stretches:
        names = ("verdict", "first", "last", "start", "end", "p_lost", "explained", "radius", "promised", "pose", "off")
        row = {name: getattr(one, name) for name in names}
        row["place"] = None if one.place is None else {
            "pose": one.place.pose, "p_right": one.place.p_right, "status": one.place.status,
        }  # fmt: skip
        row["evidence"] = None if one.diagnosis is None else asdict(one.diagnosis) | {"text": one.diagnosis.text}
        rows.append(row)
    return rows
