"""Rank candidates: Pareto fronts, and the performance profiles of Dolan and More (2002)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

Key = tuple[str, str, str]

LIMITS = {"ranges": ("ranges", "wrong_1", 0.01), "beam": ("comparable", "kl", 0.01),
          "field": ("comparable", "kl", 0.01)}  # fmt: skip
"""By problem: kind and name of the error that decides whether a point solves it, and the largest error allowed."""
LIMIT_TEXT = {
    "ranges": "at most 1 % of the rays wrong by more than one cell",
    "beam": "posterior at a comparable temperature within 0.01 nats (Kullback-Leibler) of the exact one",
    "field": "posterior at a comparable temperature within 0.01 nats (Kullback-Leibler) of the exact one",
}


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Find the points that no other point dominates, that is, is no larger in both and smaller in one.

    Args:
        points: (error, time) of each point.

    Returns:
        Indices of these points by rising error; of equal points the first.
    """
    front: list[int] = []
    fastest = math.inf
    for i in sorted(range(len(points)), key=lambda i: (*points[i], i)):
        if points[i][1] < fastest:
            front.append(i)
            fastest = points[i][1]
    return front


def performance_profile(times: Mapping[Any, Sequence[float | None]]) -> dict[Any, list[tuple[float, float]]]:
    """Compute the share of problems that each solver solves within a factor tau of the fastest solver.

    Args:
        times: For each solver its time on every problem, > 0, or None where it does not solve it; all of one length.

    Returns:
        For each solver the steps (tau, share) of its profile by rising tau; from each tau on the share holds. A solver
        that solves no problem has no steps. Problems without a solver count in the denominator.
    """
    count = max((len(values) for values in times.values()), default=0)
    best = [min((v[i] or math.inf for v in times.values()), default=math.inf) for i in range(count)]
    profile = {}
    for solver, values in times.items():
        ratios = sorted(value / best[i] for i, value in enumerate(values) if value is not None)
        steps: list[tuple[float, float]] = []
        for solved, ratio in enumerate(ratios, 1):
            if steps and steps[-1][0] == ratio:
                steps.pop()
            steps.append((ratio, solved / count))
        profile[solver] = steps
    return profile


def profiles_of(points: Sequence[Mapping[str, Any]], timing: str = "call") -> list[dict[str, Any]]:
    """Compute the profiles of a report, one per problem and kind of device; times are not compared across hardware.

    A solver is a method with a fixed knob on one backend in one precision. A method's profile has the knob that solves
    most problems; among several of these, the knob with the least geometric mean of its ratios to the fastest solver.

    Args:
        points: Points of a report.
        timing: ``"call"`` or ``"launch"``.
    """
    profiles = []
    for problem, (kind, name, limit) in LIMITS.items():
        for hardware in ("gpu", "cpu"):
            chosen = [p for p in points if p["problem"] == problem and p["kind"] == hardware]
            places = list(dict.fromkeys((p["scene"], p["cloud"]) for p in chosen))
            times: dict[tuple[Key, str], list[float | None]] = {}
            for point in chosen:
                solver = (_curve(point), setting(point))
                row = times.setdefault(solver, [None] * len(places))
                row[places.index((point["scene"], point["cloud"]))] = _time_within(point, timing, kind, name, limit)
            solved = {solver: row for solver, row in times.items() if any(value is not None for value in row)}
            if not solved:
                continue
            steps = performance_profile(solved)
            curves = [
                {"backend": backend, "method": method, "precision": precision, "setting": at, "steps": steps[solver]}
                for solver in _best_settings(steps)
                for (backend, method, precision), at in (solver,)
            ]
            profiles.append({
                "problem": problem, "kind": hardware, "timing": timing, "limit": LIMIT_TEXT[problem],
                "problems": [f"{scene}, {cloud}" for scene, cloud in places], "curves": curves,
            })  # fmt: skip
    return profiles


def _best_settings(steps: Mapping[tuple[Key, str], list[tuple[float, float]]]) -> list[tuple[Key, str]]:
    best: dict[Key, tuple[tuple[float, float], str]] = {}
    for (curve, at), profile in steps.items():
        before, mean = 0.0, 0.0
        for ratio, share in profile:
            mean += (share - before) * math.log(ratio)
            before = share
        rank = (-before, mean / before)
        if curve not in best or rank < best[curve][0]:
            best[curve] = (rank, at)
    return [(curve, at) for curve, (_, at) in best.items()]


def _time_within(point: Mapping[str, Any], timing: str, kind: str, name: str, limit: float) -> float | None:
    error = error_of(point, kind, name)
    return time_of(point, timing) if error is not None and error <= limit else None


def _curve(point: Mapping[str, Any]) -> Key:
    return point["backend"], label(point), point["precision"]


def label(point: Mapping[str, Any]) -> str:
    """Name a point's method with its variant."""
    return f"{point['method']}, {point['variant']}" if point["variant"] else str(point["method"])


def setting(point: Mapping[str, Any]) -> str:
    """Format a point's knob with its value; empty without a knob."""
    return f"{point['knob']} = {point['value']:g}" if point["knob"] else ""


def error_of(point: Mapping[str, Any], kind: str, name: str) -> float | None:
    """Return an error of a point; None where the point failed or lacks that kind."""
    value = ((point.get("errors") or {}).get(kind) or {}).get(name)
    return None if value is None or point["status"] != "ok" else float(value)


def time_of(point: Mapping[str, Any], timing: str) -> float | None:
    """Return the least time of a point's calls or launches [s]; None where it was not measured."""
    value = (point.get("time") or {}).get(f"{timing}_min_s")
    return float(value) if value else None
