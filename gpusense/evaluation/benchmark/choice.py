"""Choose the method for an affordable error or time: the fastest within the error, or the most exact within the time.

A method is judged over all scenes and clouds of a report together, by its largest error and the geometric mean of its
times. A run of another day should choose the same, so no difference that noise makes decides: methods within ``ALIKE``
of the fastest count as equally fast and those within ``CLOSE`` of the least error as equally exact, and of equal ones
:attr:`Row.preference` decides, in which nothing is measured. An error must also keep its limit for other seeds.

Still a method near one of these factors is within it on one day and not on the next. So an earlier choice may stand: it
is kept until another method is better by more than what noise of both days makes, the square of the factor.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from gpusense.evaluation.benchmark.report import ALL, MODEL_MEASURES, NEEDS, Row, model_rows

ALIKE = 1.25
"""Factor of the times below which two methods are equally fast."""
CLOSE = 1.25
"""Factor of the errors below which two methods are equally exact."""
ROUNDING = 1e-6
"""Errors below this are equal: rounding of float32."""

# By unit of a limit, the unit of the measure to which it applies, and the largest error if no limit is passed.
_UNITS = {"%": "share", "cells": "cells", "nats": "nats", "m": "m"}
_LIMITS = {"share": 0.01, "nats": 0.01}


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return indices of the points that none dominates, by rising error; of equal points the first."""
    front: list[int] = []
    fastest = math.inf
    for i in sorted(range(len(points)), key=lambda i: (*points[i], i)):
        if points[i][1] < fastest:
            front.append(i)
            fastest = points[i][1]
    return front


def front(rows: Sequence[Row], measure: str) -> list[Row]:
    """Return the rows that no row beats in error and time, by rising error; errors of rounding are equal."""
    places = [(row.errors[measure] if row.errors[measure] > ROUNDING else 0.0, row.seconds) for row in rows]
    return [rows[i] for i in pareto_front(places)]


def choose(
    rows: Sequence[Row], measure: str, error: float | None, seconds: float | None, standing: Row | None = None
) -> Row | None:
    """Choose the row for a largest error by a measure, and a longest time.

    A largest error selects the fastest method within both limits; a longest time alone selects the fastest of the most
    exact methods within it. The preferred one wins a tie.

    ``error``: The largest error; None without a limit. ``seconds``: The longest time [s]; None without a limit.
    ``standing``: The choice of an earlier day among ``rows``: it stands where its error and time keep the limits and
    no method is better by more than the squares of ``ALIKE`` and ``CLOSE``. None: there is none.

    Returns:
        The row; None if no row is within the limits.
    """
    able = [
        row
        for row in rows
        if (error is None or row.errors[measure] * (1 if row is standing else row.doubt) <= error)
        and (seconds is None or row.seconds <= seconds)
    ]
    if not able:
        return None
    least = max(min(row.errors[measure] for row in able), ROUNDING) if error is None else math.inf
    exact = [row for row in able if row.errors[measure] <= CLOSE * least]
    fastest = min(row.seconds for row in exact)
    for row in able:
        if row is standing and row.errors[measure] <= CLOSE**2 * least and row.seconds <= ALIKE**2 * fastest:
            return row
    return min((row for row in exact if row.seconds <= ALIKE * fastest), key=lambda row: row.preference)


def error_text(value: float, unit: str) -> str:
    """Format an error in its unit: shares in percent, lengths in millimetres or centimetres."""
    if unit == "share":
        return f"{100 * value:.2g} %"
    if unit == "m":
        return f"{1e3 * value:.2g} mm" if value < 0.01 else f"{100 * value:.3g} cm"
    return f"{value if value > ROUNDING else 0:.2g} {unit}"


def time_text(seconds: float) -> str:
    """Format a time: microseconds, milliseconds or seconds."""
    for unit, scale in (("us", 1e6), ("ms", 1e3)):
        if seconds * scale < 1000:
            return f"{seconds * scale:.3g} {unit}"
    return f"{seconds:.3g} s"


def choices(
    report: Mapping[str, Any], errors: Mapping[str, float], seconds: float | None = None
) -> Iterator[tuple[str, str, list[tuple[str, str, str, str]]]]:
    """Yield the choice for each need and device of a report: device, answer, and rows of the Pareto front.

    ``errors``: By unit the largest error: a share for ``"%"``, metres for ``"m"``. ``seconds``: Longest time of a call
    [s]; None without a limit.
    """
    every = [row for row in model_rows(report, elapsed=True) if row.scene == ALL and not row.maps]
    wanted = {_UNITS[unit]: error for unit, error in errors.items()}
    for problem, backend in dict.fromkeys((point["problem"], point["backend"]) for point in report["points"]):
        need, measures = NEEDS[problem], dict[str, str]()
        for *_, text, unit in MODEL_MEASURES[need]:
            measures.setdefault(unit, text)
        unit = next((unit for unit in wanted if unit in measures), next(iter(measures)))
        measure, limit = measures[unit], wanted.get(unit, _LIMITS.get(unit) if seconds is None else None)
        points = [point for point in report["points"] if (point["problem"], point["backend"]) == (problem, backend)]
        rows = [row for row in every if (row.need, row.device) == (need, backend) and measure in row.errors]
        limits = [f"error at most {error_text(limit, unit)}"] if limit is not None else []
        limits += [f"at most {time_text(seconds)}"] if seconds is not None else []
        best, found = choose(rows, measure, limit, seconds), "no method"
        if best is not None:
            found = f"{best.text}: {time_text(best.seconds)}, {error_text(best.errors[measure], unit)}"
        elif not rows:
            found = next((f"not measured: {one['reason']}" for one in points if one["status"] == "left out"), found)
        size = f"{points[0]['particles']} x {points[0]['beams']}"
        table = [
            (need, one.text, error_text(one.errors[measure], unit), time_text(one.seconds))
            for one in front(rows, measure)
        ]
        yield backend, f"{need} on {backend}, {size}, {', '.join(limits)}: {found}", table
