"""Choose the method for an affordable error or time: the fastest within the error, or the most exact within the time.

A method is judged over all scenes and clouds of a report together, by its largest error and the geometric mean of its
times. A run of another day should choose the same, so no difference that noise makes decides: methods within ``ALIKE``
of the fastest count as equally fast and those within ``CLOSE`` of the least error as equally exact, and of equal ones
:attr:`Entry.preference` decides, in which nothing is measured. An error must also keep its limit for other seeds.

Still a method near one of these factors is within it on one day and not on the next. So an earlier choice may stand: it
is kept until another method is better by more than what noise of both days makes, the square of the factor.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

ALIKE = 1.25
"""Factor of the times below which two methods are equally fast."""
CLOSE = 1.25
"""Factor of the errors below which two methods are equally exact."""
ROUNDING = 1e-6
"""Errors below this are equal: rounding of float32."""


LENGTHS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_POSTERIOR = {"nats": ("comparable", "kl"), "m": ("comparable", "shift_m")}
MEASURES = {"ranges": {"%": ("ranges", "wrong_1"), "cells": ("ranges", "p95")}, "beam": _POSTERIOR, "field": _POSTERIOR}
"""By problem and unit, the place in a point of the error to which a limit applies; the first one is the default."""
DEFAULTS = {"ranges": ("%", 0.01), "beam": ("nats", 0.01), "field": ("nats", 0.01)}
"""By problem, the unit and the largest error if no limit is passed."""
_NUMBER = re.compile(r"[0-9.]+")
# Methods that gpusense takes where none is named.
_DEFAULT = ("exact", "field", "beam", "auto", "em", "nearest")
# Knobs whose smaller values are finer; of the others larger ones are.
_SMALLER = ("tolerance", "every", "bin width")
_QUANTITY = re.compile(r"\s*([0-9.]+(?:[eE][-+]?[0-9]+)?)\s*([a-z%]+)\s*")
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}


@dataclass(frozen=True)
class Entry:
    """A method with its setting on one device.

    Attributes:
        error: Largest error over scenes and clouds, in the unit of its measure (shares as shares, lengths in metres).
        seconds: Geometric mean of the times of a call [s].
        doubt: Factor of the error within which that of another run lies; 1 where all runs have the same errors.
    """

    method: str
    setting: str
    precision: str
    error: float
    seconds: float
    exact: bool = False
    doubt: float = 1.0

    @property
    def preference(self) -> tuple[bool, bool, int, bool, str, float]:
        """Place among equal methods: exact, float32, few assumptions, a default, name, and the coarsest setting."""
        numbers = math.prod(float(number) for number in _NUMBER.findall(self.setting))
        coarse = -numbers if self.setting.startswith(_SMALLER) else numbers
        other = self.method not in _DEFAULT
        return not self.exact, self.precision != "float32", self.method.count(","), other, self.method, coarse

    @property
    def text(self) -> str:
        """Name the method with its setting and precision."""
        return ", ".join(word for word in (self.method, self.setting, self.precision) if word)


def parse_error(text: str) -> tuple[str, float]:
    """Read a limit of the error, such as "0.01 nats", "2 cm" or "1 %"; return unit and value (a share for "%")."""
    value, unit = _quantity(text, ("nats", "cells", "%", *LENGTHS), "--max-error")
    if unit in LENGTHS:
        return "m", value * LENGTHS[unit]
    return unit, value / 100 if unit == "%" else value


def parse_time(text: str) -> float:
    """Read a limit of the time of a call, such as ``"1 ms"``; return seconds."""
    value, unit = _quantity(text, tuple(_SECONDS), "--max-time")
    return value * _SECONDS[unit]


def _quantity(text: str, units: Sequence[str], name: str) -> tuple[float, str]:
    rule = f"{name}: must be a number > 0 with a unit of {', '.join(units)}"
    match = _QUANTITY.fullmatch(text)
    try:
        value = float(match[1]) if match else math.nan
    except ValueError:
        value = math.nan
    if match is None or match[2] not in units or not 0 < value < math.inf:
        raise ValueError(f"{rule}, got {text!r}")
    return value, match[2]


def entries(points: Iterable[Mapping[str, Any]], problem: str, unit: str, backend: str) -> list[Entry]:
    """Return the methods of a problem on one device (``"outside"`` for others), over all measured scenes and clouds.

    A method that failed, was left out or is not finite in any of them is not listed. A scene where every method was
    left out, such as one after the deadline of a quick run, does not count.
    """
    chosen = [point for point in points if point["problem"] == problem and point["backend"] == backend]
    places = {(point["scene"], point["cloud"]) for point in chosen if point["status"] != "left out"}
    groups: dict[tuple[str, str, str], list[Mapping[str, Any]]] = {}
    for point in chosen:
        if (point["scene"], point["cloud"]) in places:
            groups.setdefault((label(point), setting(point), point["precision"]), []).append(point)
    listed = []
    for (method, at, precision), group in groups.items():
        errors = [error_of(point, *MEASURES[problem][unit]) for point in group]
        times = [time_of(point) for point in group]
        if not any(value is None for value in (*errors, *times)):
            seconds = math.exp(sum(math.log(time or 1.0) for time in times) / len(times))
            error = max(error or 0.0 for error in errors)
            listed.append(Entry(method, at, precision, error, seconds, bool(group[0]["exact"])))
    return listed


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return indices of the points that none dominates, by rising error; of equal points the first."""
    front: list[int] = []
    fastest = math.inf
    for i in sorted(range(len(points)), key=lambda i: (*points[i], i)):
        if points[i][1] < fastest:
            front.append(i)
            fastest = points[i][1]
    return front


def front(listed: Sequence[Entry]) -> list[Entry]:
    """Return the entries that no entry beats in error and time, by rising error; errors of rounding are equal."""
    places = [(entry.error if entry.error > ROUNDING else 0.0, entry.seconds) for entry in listed]
    return [listed[i] for i in pareto_front(places)]


def choose(
    listed: Sequence[Entry], error: float | None, seconds: float | None, standing: Entry | None = None
) -> Entry | None:
    """Choose the entry for a largest error and a longest time.

    A largest error selects the fastest method within both limits; a longest time alone selects the fastest of the most
    exact methods within it. The preferred one wins a tie.

    ``error``: The largest error; None without a limit. ``seconds``: The longest time [s]; None without a limit.
    ``standing``: The choice of an earlier day among ``listed``: it stands where its error and time keep the limits and
    no method is better by more than the squares of ``ALIKE`` and ``CLOSE``. None: there is none.

    Returns:
        The entry; None if no entry is within the limits.
    """
    able = [
        entry
        for entry in listed
        if (error is None or entry.error * (1 if entry == standing else entry.doubt) <= error)
        and (seconds is None or entry.seconds <= seconds)
    ]
    if not able:
        return None
    least = max(min(entry.error for entry in able), ROUNDING) if error is None else math.inf
    exact = [entry for entry in able if entry.error <= CLOSE * least]
    fastest = min(entry.seconds for entry in exact)
    if standing in able and standing.error <= CLOSE**2 * least and standing.seconds <= ALIKE**2 * fastest:
        return standing
    return min((entry for entry in exact if entry.seconds <= ALIKE * fastest), key=lambda entry: entry.preference)


def error_text(value: float, unit: str) -> str:
    """Format an error in its unit: shares in percent, lengths in millimetres or centimetres."""
    if unit == "%":
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
    points: Sequence[Mapping[str, Any]], errors: Mapping[str, float], seconds: float | None = None
) -> Iterator[tuple[str, str, list[tuple[str, str, str, str]]]]:
    """Yield the choice for each problem and device of a report: device, answer, and rows of the Pareto front.

    ``errors``: By unit the largest error: a share for ``"%"``, metres for ``"m"``. ``seconds``: Longest time of a call
    [s]; None without a limit.
    """
    for problem, backend in dict.fromkeys((point["problem"], point["backend"]) for point in points):
        usual, most = DEFAULTS[problem]
        unit = next((unit for unit in errors if unit in MEASURES[problem]), usual)
        limit = errors.get(unit, most if seconds is None else None)
        listed = entries(points, problem, unit, backend)
        size = next(
            f"{p['particles']} x {p['beams']}" for p in points if (p["problem"], p["backend"]) == (problem, backend)
        )
        wanted = [f"error at most {error_text(limit, unit)}"] if limit is not None else []
        wanted += [f"at most {time_text(seconds)}"] if seconds is not None else []
        best, found = choose(listed, limit, seconds), "no method"
        if not listed:
            found = next((f"not measured: {p['reason']}" for p in points if _is_left_out(p, problem, backend)), found)
        if best is not None:
            found = f"{best.text}: {time_text(best.seconds)}, {error_text(best.error, unit)}"
        rows = [
            (problem, one.text.removesuffix(", float32"), error_text(one.error, unit), time_text(one.seconds))
            for one in front(listed)
        ]
        yield backend, f"{problem} on {backend}, {size}, {', '.join(wanted)}: {found}", rows


def _is_left_out(point: Mapping[str, Any], problem: str, backend: str) -> bool:
    return (point["problem"], point["backend"], point["status"]) == (problem, backend, "left out")


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


def time_of(point: Mapping[str, Any]) -> float | None:
    """Return the least time of a point's calls [s]; None where it was not measured."""
    value = (point.get("time") or {}).get("call_min_s")
    return float(value) if value else None
