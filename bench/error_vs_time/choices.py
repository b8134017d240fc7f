"""Choose the method for a limit of error or time: the first table of docs/error-vs-time.md."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from common import table

from gpusense.evaluation.benchmark.choice import choose, error_text, time_text
from gpusense.evaluation.benchmark.report import ALL, Row

WRONG, MEDIAN, TAIL, LARGEST = (
    "rays wrong by more than a cell", "median error of a ray", "95 % error of a ray", "largest error of a ray",
)  # fmt: skip
KL, FINE = "KL divergence at a comparable temperature", "KL divergence from the true posterior"
SHIFT, GLOBAL, LOG_P = "shift of the mean position", "the same, all over the map", "RMS error of log p"
# Measures of a need's figure and table; choices use the first one.
SHOWN = {
    "rays": (WRONG, MEDIAN, TAIL, LARGEST), "beam model": (KL, GLOBAL, FINE, SHIFT, LOG_P),
    "likelihood field": (KL, GLOBAL, FINE, SHIFT, LOG_P),
    "localisation": ("median error", "95 % error"), "matching": ("median error", "95 % error"),
    "in a map": ("median error", "95 % error"), "learning": ("median error", "largest error"),
    "landmarks": ("median error",),
}  # fmt: skip


@dataclass(frozen=True)
class Wish:
    """An upper limit of the error or of the time.

    Attributes:
        error: The largest error, by the need's first measure; None without a limit.
        seconds: The longest time [s]; None without a limit.
    """

    words: str
    need: str
    error: float | None = None
    seconds: float | None = None
    only: Callable[[Row], bool] = lambda row: True


def _default(row: Row) -> bool:
    """Return whether a filter has the default temperature and stages."""
    return "," not in row.setting


def _particles(count: int) -> Callable[[Row], bool]:
    return lambda row: _default(row) and row.setting.startswith(f"{count} x")


FIRST = (
    Wish("10 000 particles at 100 Hz", "localisation", seconds=0.01, only=_particles(10_000)),
    Wish("1000 particles at 100 Hz", "localisation", seconds=0.01, only=_particles(1000)),
    Wish("localisation to 2 cm", "localisation", error=0.02, only=_default),
)
WISHES = (
    *FIRST,
    Wish("beam model, at most 0.01 nats", "beam model", error=0.01),
    Wish("beam model, at most 10 ms", "beam model", seconds=0.01),
    Wish("beam model, at most 1 ms", "beam model", seconds=0.001),
    Wish("likelihood field, at most 0.01 nats", "likelihood field", error=0.01),
    Wish("likelihood field, at most 10 ms", "likelihood field", seconds=0.01),
    Wish("rays, at most 1 % wrong", "rays", error=0.01),
    Wish("match of two scans, at most 1 cm", "matching", error=0.01),
    Wish("match in a map, at most 1 cm", "in a map", error=0.01),
    Wish("parameters learned, at most 3 % off", "learning", error=0.03),
    Wish("unknown landmarks, at most 0.2 nats", "landmarks", error=0.2, only=lambda row: row.method != "known"),
)


def value(number: float, unit: str) -> str:
    """Format an error; shares and relative errors in percent, lengths in millimetres or centimetres."""
    if unit in ("share", "relative"):
        return "0" if number == 0 else error_text(number, "share")
    if unit == "nats":
        return "0" if number < 1e-6 else f"{number:.2g}"
    return f"{number:.3g}" if unit == "cells" else error_text(number, unit)


def own(rows: Iterable[Row], need: str, device: str) -> list[Row]:
    """Return gpusense's rows of a need on a device."""
    return [row for row in rows if (row.need, row.device, row.scene) == (need, device, ALL) and not row.outside]


def chosen(rows: Sequence[Row], wish: Wish, device: str, standing: str = "") -> tuple[Row | None, bool]:
    """Return the method for a wish and whether it keeps the limit, else the nearest one; None without any."""
    able = [row for row in own(rows, wish.need, device) if wish.only(row) and not row.maps]
    if not able:
        return None, False
    measure, earlier = SHOWN[wish.need][0], next((row for row in able if row.text == standing), None)
    best = choose(able, measure, wish.error, wish.seconds, earlier)
    if best is not None:
        return best, True
    # If none keeps the limit, choose the fastest or the most exact one, among equal ones by the same rule.
    return choose(able, measure, None if wish.error else math.inf, None, earlier), False


Standing = Mapping[tuple[str, str], str]
"""Answers of an earlier day by device and words of the wish."""


def standing_of(rows: Sequence[Row], devices: Sequence[str], standing: Standing) -> dict[tuple[str, str], str]:
    """Return the texts of the answers of all devices to all wishes."""
    found = {}
    for device, wish in itertools.product(devices, WISHES):
        row, _ = chosen(rows, wish, device, standing.get((device, wish.words), ""))
        if row is not None:
            found[device, wish.words] = row.text
    return found


def answer(rows: Sequence[Row], wish: Wish, device: str, standing: str = "") -> str:
    """Return the method for a wish with its time and error."""
    row, kept = chosen(rows, wish, device, standing)
    if row is None:
        return "-"
    measure = SHOWN[wish.need][0]
    unit = row.units[measure]
    figures = f"{time_text(row.seconds)}, {value(row.errors[measure], unit)}{' nats' * (unit == 'nats')}"
    return f"**{row.text}**: {figures}" if kept else f"none; nearest: {row.text}, {figures}"


def lead(rows: Sequence[Row], devices: Sequence[str], standing: Standing) -> list[str]:
    """Return the answer to the first wish in one line a device, and the code of the first processor and GPU."""
    lines, codes = [], {}
    for device in devices:
        row, kept = chosen(rows, FIRST[0], device, standing.get((device, FIRST[0].words), ""))
        if row is None:
            continue
        measure = SHOWN[FIRST[0].need][0]
        shown = _elapsed(row, measure)
        text = f"**{row.text}**: {shown}" if kept else f"none; nearest: {row.text}, {shown}"
        fewer, able = chosen(rows, FIRST[1], device, standing.get((device, FIRST[1].words), ""))
        if fewer is not None and able and _beams(fewer) > _beams(row) and fewer.errors[measure] < row.errors[measure]:
            text += f"; fewer particles with more beams: **{fewer.text}**: {_elapsed(fewer, measure)}"
        lines.append(f"- {device}: {text}")
        if kept:
            codes.setdefault("gpu" if "NVIDIA" in device else "processor", row.code)
    code = [f"{name} = {code}" for name, code in codes.items()]
    return [f"**{FIRST[0].words}:**", "", *lines, "", "```python", *code, "```"] if lines else []


def _beams(row: Row) -> int:
    """Return the beams of a setting such as "10000 x 8"."""
    return int(row.setting.split(",")[0].split(" x ")[1])


def _elapsed(row: Row, measure: str) -> str:
    """Return time and error; on a processor, the median of the elapsed time is in parentheses."""
    elapsed = "" if "NVIDIA" in row.device else f" ({time_text(row.quartiles[1])} elapsed)"
    return f"{time_text(row.seconds)}{elapsed}, {value(row.errors[measure], row.units[measure])}"


def answers(rows: Sequence[Row], devices: Sequence[str], wishes: Sequence[Wish], standing: Standing) -> list[str]:
    """Return a table of answers for each set of devices; a wish belongs to the devices that were measured for it."""
    tables: dict[tuple[str, ...], list[tuple[str, ...]]] = {}
    for wish in wishes:
        said = {device: answer(rows, wish, device, standing.get((device, wish.words), "")) for device in devices}
        said = {device: text for device, text in said.items() if text != "-"}
        tables.setdefault(tuple(said), []).append((wish.words, *said.values()))
    made = [table(("to do", *measured), lines) for measured, lines in tables.items() if measured]
    return [line for text in made for line in (text, "")][:-1]
