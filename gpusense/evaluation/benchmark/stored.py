"""Read a stored report of ``gpusense bench``, and check the fields that comparisons use."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gpusense._util import checks
from gpusense._util.documents import read_json
from gpusense.evaluation.benchmark.report import SCHEMA

_KIND = "a report of gpusense bench"
_NONE = type(None)
_SCENE: dict[str, Any] = {"name": str, "fingerprint": str}
_POINT: dict[str, Any] = {
    "scene": str, "cloud": str, "problem": str, "backend": str, "device": str, "method": str, "variant": str,
    "knob": str, "value": (int, float, _NONE), "precision": str, "code": str, "particles": int,
    "beams": int, "checked": int, "status": str, "reason": str, "time": (dict, _NONE), "errors": (dict, _NONE),
}  # fmt: skip
_ARGUMENTS = ("particles", "checked", "beams", "repeats", "seed")
_TIMES = ("call_min_s", "call_median_s")


def read_report(path: Path) -> dict[str, Any]:
    """Read a report of ``gpusense bench``.

    Raises:
        OSError, ValueError: the file is missing, is no report, or is damaged; the message names the first wrong field.
    """
    report = read_json(path, _KIND)
    wanted = {"points": list, "scenes": list, "arguments": dict, "machine": dict}
    if not isinstance(report, dict) or any(not isinstance(report.get(key), kind) for key, kind in wanted.items()):
        raise ValueError(f"{path}: must be {_KIND}, got another document")
    if report.get("schema") != SCHEMA:
        raise ValueError(f"{path}: schema must be {SCHEMA}, got {checks.show(report.get('schema'))}")
    for name, fields in (("scenes", _SCENE), ("points", _POINT)):
        for index, item in enumerate(report[name]):
            _check_fields(f"{path}: {name}[{index}]", item, fields)
    for index, point in enumerate(report["points"]):
        _check_numbers(f"{path}: points[{index}]", point)
    _check_arguments(f"{path}: arguments", report["arguments"])
    return report


def _check_arguments(where: str, arguments: Mapping[str, Any]) -> None:
    """Check the numbers that are defaults of the next run; None means the default of the device."""
    for name in _ARGUMENTS:
        value = arguments.get(name)
        if value is not None:
            _check_fields(where, arguments, {name: int})
            checks.integer(f"{where}.{name}", value, low=0 if name == "seed" else 1)


def _check_fields(where: str, item: object, fields: Mapping[str, Any]) -> None:
    """Check the types of a mapping's fields."""
    if not isinstance(item, dict):
        raise ValueError(f"{where}: must be a mapping, got {checks.show(item)}")
    for name, kinds in fields.items():
        if name not in item:
            raise ValueError(f"{where}: must have {name}, got {checks.show(list(item))}")
        if not isinstance(item[name], kinds) or isinstance(item[name], bool):
            names = " or ".join(
                "null" if kind is _NONE else kind.__name__ for kind in (kinds if isinstance(kinds, tuple) else (kinds,))
            )
            raise ValueError(f"{where}.{name}: must be of type {names}, got {checks.show(item[name])}")


def _check_numbers(where: str, point: Mapping[str, Any]) -> None:
    """Check the times and errors of a point, each a number or None."""
    for name in _TIMES if point["time"] else ():
        _check_number(f"{where}.time.{name}", point["time"].get(name), above=0)
    for kind, values in (point["errors"] or {}).items():
        if not isinstance(values, (dict, _NONE)):
            raise ValueError(f"{where}.errors.{kind}: must be a mapping or null, got {checks.show(values)}")
        for name, value in (values or {}).items():
            _check_number(f"{where}.errors.{kind}.{name}", value)


def _check_number(name: str, value: object, **limits: float) -> None:
    if value is not None:
        try:
            checks.real(name, value, **limits)
        except TypeError as error:
            raise ValueError(str(error)) from None
