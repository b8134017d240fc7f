"""Compare two reports of the same scenes: points that became slower or less exact."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from gpusense.evaluation.benchmark.profiles import error_of, label, setting, time_of

SLOWER = 1.3
"""A point is slower when both minimum and median of its times grew by more than this factor."""
_LESS_EXACT = 1.05
_KINDS = {
    "ranges": ("median", "p95", "p99", "max", "mean", "wrong_1", "wrong_2"), "log_p": ("max", "rms"),
    "posterior": ("kl", "tv", "shift_m", "shift_rad"), "tempered": ("kl", "tv", "shift_m", "shift_rad"),
    "comparable": ("kl", "tv", "shift_m", "shift_rad"), "fine": ("kl", "tv", "shift_m", "shift_rad"),
}  # fmt: skip
# Growth below this is rounding, in cells, shares, nats, metres and radians.
_FLOORS = {"ranges": 1e-4, "log_p": 1e-3, "posterior": 1e-5, "tempered": 1e-5, "comparable": 1e-5, "fine": 1e-5}

_IDENTITY = ("scene", "cloud", "problem", "backend", "method", "variant", "knob", "value", "precision", "checked")


@dataclass
class Comparison:
    """Changes from an old report to a new one, a line of text for each.

    Attributes:
        slower: Points whose times grew.
        faster: Points whose times fell by the same factor.
        less_exact: Points with an error that grew, and points that no longer work.
        untimed: Number of points whose times are not comparable: another device or number of particles.
        compared: Number of points in both reports.
        gone: Number of points that are only in the old report.
        others: Scenes with one name but different maps, scans or particles; their points are not compared.
    """

    slower: list[str] = field(default_factory=list)
    faster: list[str] = field(default_factory=list)
    less_exact: list[str] = field(default_factory=list)
    untimed: int = 0
    compared: int = 0
    gone: int = 0
    others: list[str] = field(default_factory=list)


def compare(old: Mapping[str, Any], new: Mapping[str, Any], slower: float = SLOWER) -> Comparison:
    """Compare the points that two reports share.

    Args:
        old: A report.
        new: A later one.
        slower: The factor above which a point counts as slower, > 1.
    """
    result = Comparison()
    before = {scene["name"]: scene["fingerprint"] for scene in old["scenes"]}
    result.others = [s["name"] for s in new["scenes"] if before.get(s["name"], s["fingerprint"]) != s["fingerprint"]]
    known = {_identity(point): point for point in new["points"]}
    same_machine = old["machine"].get("processor") == new["machine"].get("processor")
    for point in old["points"]:
        if point["scene"] in result.others or point["status"] == "left out":
            continue
        now = known.get(_identity(point))
        if now is None or now["status"] == "left out":
            result.gone += 1
            continue
        result.compared += 1
        result.less_exact += _less_exact(point, now)
        if same_machine and all(point[name] == now[name] for name in ("device", "particles", "beams")):
            _compare_times(result, point, now, slower)
        else:
            result.untimed += 1
    return result


def _compare_times(result: Comparison, old: Mapping[str, Any], new: Mapping[str, Any], slower: float) -> None:
    before, now = time_of(old, "call"), time_of(new, "call")
    if before is None or now is None:
        return
    # On a shared machine either of the two may grow by chance.
    medians = old["time"].get("call_median_s"), new["time"].get("call_median_s")
    growths = [now / before, medians[1] / medians[0] if all(medians) else now / before]
    line = f"{name_of(new)}: {before * 1e3:.4g} ms, now {now * 1e3:.4g} ms ({now / before:.2f} times)"
    if min(growths) > slower:
        result.slower.append(line)
    elif max(growths) < 1 / slower:
        result.faster.append(line)


def _less_exact(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    if old["status"] == "ok" and new["status"] != "ok":
        return [f"{name_of(new)}: {new['status']}: {new['reason']}"]
    lines = []
    for kind, names in _KINDS.items():
        for name in names:
            before, now = error_of(old, kind, name), error_of(new, kind, name)
            if before is not None and now is not None and now > _LESS_EXACT * before + _FLOORS[kind]:
                lines.append(f"{name_of(new)}: {kind} {name} {before:.4g}, now {now:.4g}")
    return lines


def _identity(point: Mapping[str, Any]) -> tuple[Any, ...]:
    return tuple(point[name] for name in _IDENTITY)


def name_of(point: Mapping[str, Any]) -> str:
    """Describe a point in words."""
    words = (point["scene"], point["cloud"], point["problem"], point["backend"], point["precision"], label(point))
    return ", ".join(word for word in (*words, setting(point)) if word)


def lines_of(comparison: Comparison, slower: float = SLOWER) -> list[str]:
    """Format a comparison as lines of text."""
    lines = [f"{comparison.compared} points compared, {comparison.gone} of the old report not measured now"]
    if comparison.others:
        lines.append(f"not comparable, another map, scan or cloud: {', '.join(comparison.others)}")
    if comparison.untimed:
        lines.append(f"{comparison.untimed} points with another device or size: their times are not compared")
    for title, entries in (
        (f"slower by more than {slower:g} times", comparison.slower),
        (f"faster by more than {slower:g} times", comparison.faster),
        ("less exact", comparison.less_exact),
    ):
        lines += ["", f"{title}: {len(entries) or 'none'}", *(f"  {entry}" for entry in entries)]
    return lines
