"""Write the report of a run as one JSON document, and rank methods in rows."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from gpusense._util.documents import plain
from gpusense.evaluation.benchmark.runner import Outcome, Plan

SCHEMA = 2
"""Version of the report's fields."""

_DIGITS = 6


def document(
    plan: Plan, outcome: Outcome, arguments: Mapping[str, Any], machine: Mapping[str, Any], absent: Sequence[str],
    command: str = "",
) -> dict[str, Any]:  # fmt: skip
    """Build the report from plain values; non-finite numbers become None."""
    made: dict[str, Any] = plain({
        "schema": SCHEMA, "date": time.strftime("%Y-%m-%d"), "command": command, "arguments": arguments,
        "machine": machine, "devices": [backend.info for backend in plan.backends], "absent": absent,
        "truth": outcome.truth, "scenes": outcome.scenes, "points": outcome.points,
    }, _DIGITS)  # fmt: skip
    return made


ALL = "all maps"
_NUMBER = re.compile(r"[0-9.]+")
# Methods that gpusense takes where none is named.
_DEFAULT = ("exact", "field", "beam", "auto", "em", "nearest")
# Knobs whose smaller values are finer; of the others larger ones are.
_SMALLER = ("tolerance", "every", "bin width")
NEEDS = {"ranges": "rays", "beam": "beam model", "field": "likelihood field"}
# Measures of each need as (place in a point, cloud or "" for all, text, unit); the limit applies to the first.
MODEL_MEASURES = {
    "rays": (
        (("ranges", "wrong_1"), "", "rays wrong by more than a cell", "share"),
        (("ranges", "p95"), "", "95 % error of a ray", "cells"),
        (("ranges", "median"), "", "median error of a ray", "cells"),
        (("ranges", "max"), "", "largest error of a ray", "cells"),
    ),
    "beam model": (
        (("comparable", "kl"), "tracking", "KL divergence at a comparable temperature", "nats"),
        (("comparable", "kl"), "global", "the same, all over the map", "nats"),
        (("fine", "kl"), "tracking", "KL divergence from the true posterior", "nats"),
        (("comparable", "shift_m"), "tracking", "shift of the mean position", "m"),
        (("log_p", "rms"), "tracking", "RMS error of log p", "nats"),
    ),
}
MODEL_MEASURES["likelihood field"] = MODEL_MEASURES["beam model"]


@dataclass(frozen=True)
class Case:
    """A method in one scene: a map with a cloud.

    Attributes:
        errors: By the text of the measure; only measures of this cloud.
    """

    name: str
    seconds: float
    errors: Mapping[str, float]


@dataclass(frozen=True)
class Row:
    """A method on a device, in one map or in all.

    Attributes:
        need: Need that it serves, a value of ``NEEDS``.
        scene: Name of the map; ``ALL`` for the worst error and the mean time over all maps.
        seconds: Time of a call, a step or a match: on a processor its CPU time over all cores, on a GPU the least
            elapsed time.
        quartiles: Quartiles of the elapsed times [s]; geometric means over the maps.
        errors: By the text of the measure.
        outside: Version and threads of another implementation; empty for gpusense.
        work: Rays or readings of a call; 1 for tasks.
        maps: "8 of 10 clouds" if some were left out because of the time that a table takes; such a row is never chosen.
        cases: For a row of all maps, each scene by itself.
        origin: Command that measured it, with date and commit.
        doubt: Factor of the error within which the error of another run lies; 1 if all runs have the same errors.
    """

    need: str
    device: str
    scene: str
    method: str
    setting: str
    precision: str
    code: str
    seconds: float
    quartiles: tuple[float, float, float]
    errors: Mapping[str, float]
    units: Mapping[str, str]
    exact: bool = False
    outside: str = ""
    work: int = 1
    maps: str = ""
    cases: tuple[Case, ...] = ()
    origin: str = ""
    doubt: float = 1.0

    @property
    def text(self) -> str:
        """Name the method with setting and precision; float32 is not named."""
        precision = self.precision if self.precision != "float32" and self.need != "learning" else ""
        text = ", ".join(word for word in (self.method, self.setting, precision) if word)
        return f"{text} ({self.maps})" if self.maps else text

    @property
    def preference(self) -> tuple[bool, bool, int, bool, str, float]:
        """Place among equal methods: exact, float32, few assumptions, a default, name, and the coarsest setting."""
        numbers = math.prod(float(number) for number in _NUMBER.findall(self.setting))
        coarse = -numbers if self.setting.startswith(_SMALLER) else numbers
        other = self.method not in _DEFAULT
        return not self.exact, self.precision != "float32", self.method.count(","), other, self.method, coarse


def origin_of(report: Mapping[str, Any]) -> str:
    """Name the command of a report, its date and, if known, its commit."""
    commit = f", commit {report['commit']}" if report.get("commit") else ""
    return f"{report['command'] or 'gpusense bench'} ({report['date']}{commit})"


def mean(numbers: Iterable[float]) -> float:
    """Return the geometric mean of positive numbers."""
    logs = [math.log(number) for number in numbers]
    return math.exp(sum(logs) / len(logs))


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


def seconds_of(point: Mapping[str, Any], *, elapsed: bool = False) -> float | None:
    """Return the time of a point: CPU time on a processor, least elapsed time on a GPU or if ``elapsed``."""
    name = "call_min_s" if elapsed or point["kind"] == "gpu" else "processor_s"
    value = (point["time"] or {}).get(name)
    return float(value) if value else None


def model_rows(
    report: Mapping[str, Any], titles: Mapping[str, str] | None = None, *, elapsed: bool = False
) -> list[Row]:
    """Return the rows of a report of ``gpusense bench``, for each map and for all together.

    ``titles``: Names of the devices by their selection strings, which name them by default. ``elapsed``: Whether to
    take elapsed times on processors too.

    A method that failed in a scene has no row for the scene and none for all maps. A scene where every method was left
    out, such as one after the deadline of a quick run, does not count.
    """
    origin = origin_of(report)
    groups: dict[tuple[str, ...], list[Mapping[str, Any]]] = {}
    everywhere: dict[tuple[str, ...], set[tuple[str, str]]] = {}
    for point in report["points"]:
        run = (NEEDS[point["problem"]], point["backend"], point["precision"])
        groups.setdefault((*run, point["device"], label(point), setting(point)), []).append(point)
        if point["status"] != "left out":
            everywhere.setdefault(run, set()).add((point["scene"], point["cloud"]))
    rows = []
    for (need, backend, precision, *_), group in groups.items():
        kept = [point for point in group if point["status"] != "left out"]
        whole = len(everywhere.get((need, backend, precision), ()))
        for scene in [*dict.fromkeys(point["scene"] for point in kept), ALL]:
            part = kept if scene == ALL else [point for point in kept if point["scene"] == scene]
            made = _model_row(need, (titles or {}).get(backend, backend), scene, part, elapsed) if part else None
            if made is not None:
                some = scene == ALL and len(part) < whole
                maps = f"{len(part)} of {whole} clouds" if some else ""
                cases = tuple(_case(need, point) for point in part) if scene == ALL else ()
                rows.append(replace(made, maps=maps, cases=cases, origin=origin))
    return rows


def _measured(need: str, point: Mapping[str, Any]) -> dict[str, float]:
    """Return the errors of a point that concern its cloud, by their texts."""
    places = {text: place for place, cloud, text, _ in MODEL_MEASURES[need] if cloud in ("", point["cloud"])}
    known = {text: error_of(point, *place) for text, place in places.items()}
    return {text: error for text, error in known.items() if error is not None}


def _case(need: str, point: Mapping[str, Any]) -> Case:
    return Case(f"{point['scene']}, {point['cloud']}", seconds_of(point) or 0.0, _measured(need, point))


def _model_row(need: str, title: str, scene: str, group: Sequence[Mapping[str, Any]], elapsed: bool) -> Row | None:
    times = [seconds_of(point, elapsed=elapsed) for point in group]
    if any(time is None or point["status"] != "ok" for time, point in zip(times, group, strict=True)):
        return None
    found = [_measured(need, point) for point in group]
    errors = {
        text: max(each[text] for each in found if text in each)
        for _, _, text, _ in MODEL_MEASURES[need]
        if any(text in each for each in found)
    }
    units = {text: unit for _, _, text, unit in MODEL_MEASURES[need] if text in errors}
    first = group[0]
    low, middle, high = (mean(point["time"][f"call_{name}_s"] for point in group) for name in ("q1", "median", "q3"))
    return Row(
        need, title, scene, label(first), setting(first), first["precision"], first["code"],
        mean(time or 1.0 for time in times), (low, middle, high), errors, units, bool(first["exact"]),
        first["device"] if first["outside"] else "", first["work"],
    )  # fmt: skip
