"""Every argument of every public call, at values that no caller should pass: a right result, or an error that names it.

A call may return, or raise ValueError or TypeError with the argument, the rule and the value. It gives no warning of
NumPy, writes nothing to standard error, and raises nothing else.
"""

from __future__ import annotations

import dataclasses
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.public_calls import Call, calls

import gpusense as gs

# Calls whose results have NaN for what is unknown: errors of parameters, missing readings, shares of no evidence.
UNKNOWN = re.compile(
    r"fit_\w+|DiscreteBeamModel\.learn|suspicious_landmarks|chain_scans|\w+\.incidence|\w+\.sample|deskew_scan"
    r"|wrap_angle|ParticleFilter\.correct|PoseMonitor\.update|trilaterate|triangulate\w*|locate|locate_scan"
    r"|judge_trajectory|pose_likelihood|LandmarkMap|read_log|Shapes"
)
# Other names of arguments in messages: fields of a mapping, readings of a sensor, the map of a model.
ALIASES = {
    "DiscreteBeamModel.from_dict": ("fields",), "IncidenceParameters.from_dict": ("fields",),
    "ParticleFilter.correct": ("ranges",), "PoseMonitor.update": ("readings",),
    "ParticleFilter.initialize_uniform": ("map",),
}  # fmt: skip
# Calls of seconds draw one value.
HEAVY = {
    "DiscreteBeamModel.learn", "chain_scans", "fit_incidence_parameters", "landmarks_of_map", "fit_beam_parameters",
    "fit_odometry_motion", "locate_scan", "fit_landmark_parameters", "calibrate_temperature", "match_map",
}  # fmt: skip
# Work in proportion to a value that is valid: as many poses as cells.
LONG = {("landmarks_of_map", "spacing")}

SCALARS: dict[str, Any] = {
    "1e-300": 1e-300, "1e300": 1e300, "1e155": 1e155, "-1e155": -1e155, "5e-324": 5e-324, "1e30": 1e30, "1e9": 1e9,
    "1e-9": 1e-9, "nan": float("nan"), "inf": float("inf"), "-inf": float("-inf"), "None": None, "text": "no",
    "bytes": b"x", "True": True, "numpy bool": np.bool_(True), "-1": -1, "0": 0, "1": 1, "0.0": 0.0, "1.0": 1.0,
    "2**31": 2**31, "2**63": 2**63, "10**40": 10**40, "-10**40": -(10**40), "10**400": 10**400, "complex": 1j,
    "mapping": {}, "object": object(), "empty": [], "pair": [1.0, 2.0], "three": np.ones(3), "square": np.ones((2, 2)),
    "no rows": np.zeros((0, 3)), "zero dimensions": np.array(1e300), "texts": ["a"], "ragged": [[1], [1, 2]],
}  # fmt: skip


def arrays_like(base: object) -> dict[str, Any]:
    """Return arrays of extreme values, other shapes and other types in place of a valid array."""
    try:
        valid = np.asarray(base)
    except ValueError:
        return {}
    if valid.dtype.kind not in "fiub" or valid.ndim == 0 or valid.size == 0:
        return {}
    wide = valid.astype(np.float64)
    found: dict[str, Any] = {}
    for value in (1e300, 1e155, -1e155, 1e30, 1e-300, np.nan, np.inf, -np.inf):
        one = wide.copy()
        one.flat[-1] = value
        found |= {f"one {value}": one, f"all {value}": np.full_like(wide, value)}
    found |= {f"times {factor}": wide * factor for factor in (1e155, 1e20, 1e-20, 1e-155, 1e-300)}
    found |= {
        "complex": wide.astype(complex), "texts": wide.astype(str), "objects": wide.astype(object),
        "bools": wide.astype(bool), "zeros": 0 * wide, "shorter": wide[:-1], "flat": wide.ravel(), "deeper": wide[None],
        "longer": np.concatenate([wide, wide]), "narrower": wide[..., :-1],
        "the same": np.full_like(wide, wide.flat[0]), "huge integers": np.full(valid.shape, 2**62),
        "unsigned": np.full(valid.shape, 2**64 - 1, np.uint64),
    }  # fmt: skip
    return found


def trials(name: str, call: Call) -> list[tuple[str, str]]:
    """Return the arguments of a call, each with the keys of its values."""
    return [
        (argument, key)
        for argument, base in call.arguments.items()
        for key in (*SCALARS, *(f"like {key}" for key in arrays_like(base)))
        if (name, argument) not in LONG
    ]


def complaint(name: str, call: Call, argument: str, key: str, capfd: pytest.CaptureFixture[str]) -> str:
    """Return the fault of a call with one value replaced; an empty text for none."""
    base = call.arguments[argument]
    value = arrays_like(base)[key.removeprefix("like ")] if key.startswith("like ") else SCALARS[key]
    function = call.function()
    found, result = "", None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            result = function(**(call.arguments | {argument: value}))
        except (ValueError, TypeError) as error:
            text = str(error)
            words = (*call.arguments, *ALIASES.get(name, ()))
            named = any(re.search(rf"\b{re.escape(each)}\b", text) for each in words)
            found = "" if named and "got " in text else f"{type(error).__name__}: {text[:200]}"
        except (OSError, RuntimeError) as error:
            missing = isinstance(error, OSError) and argument == "path"
            expected = missing or str(error).startswith(f"{argument}: ")
            found = "" if expected else f"{type(error).__name__}: {error}"
        except Exception as error:
            found = f"{type(error).__name__}: {error}"
        else:
            if isinstance(base, bool) and not isinstance(value, (bool, np.bool)):
                found = "accepted in place of a bool"
            elif not UNKNOWN.fullmatch(name) and any(np.isnan(part).any() for part in numbers_in(result)):
                found = "NaN in the result"
    noise = [str(one.message) for one in caught if not issubclass(one.category, gs.PlausibilityWarning)]
    printed = capfd.readouterr().err
    return " ".join(part for part in (found, *(f"warning: {text}" for text in noise), printed) if part)


def numbers_in(value: Any) -> Iterator[np.ndarray]:
    """Yield the floating numbers in a result."""
    if isinstance(value, (float, np.floating, np.ndarray)):
        array = np.asarray(value)
        if array.dtype.kind == "f":
            yield array
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            yield from numbers_in(getattr(value, field.name))
    elif isinstance(value, (tuple, list)):
        for each in value:
            yield from numbers_in(each)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Take an empty folder, in which calls may write a file of any name."""
    monkeypatch.chdir(tmp_path)


def check(name: str, chosen: list[tuple[str, str]], capfd: pytest.CaptureFixture[str]) -> None:
    call = calls()[name]
    capfd.readouterr()
    faults = {(argument, key): complaint(name, call, argument, key, capfd) for argument, key in chosen}
    assert {place: text for place, text in faults.items() if text} == {}


@pytest.mark.parametrize("name", calls())
def test_drawn_values_give_a_right_result_or_a_named_error(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    every = trials(name, calls()[name])
    rng = np.random.default_rng([len(name), *name.encode()])
    count = 1 if name in HEAVY else min(30, len(every))
    check(name, [every[k] for k in rng.choice(len(every), count, replace=False)], capfd)


@pytest.mark.slow
@pytest.mark.parametrize("name", calls())
def test_all_values_give_a_right_result_or_a_named_error(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    check(name, trials(name, calls()[name]), capfd)


def test_the_valid_arguments_are_accepted(capfd: pytest.CaptureFixture[str]) -> None:
    for name, call in calls().items():
        if name not in HEAVY:
            call.function()(**call.arguments)
    assert capfd.readouterr().err == ""
