"""Select the backends of tests; an absent backend skips or fails a test."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Callable, Iterable

import pytest

from gpusense.backends import get_backend
from gpusense.backends.registry import ENTRIES

# Backends of tests; with a GPU for example GPUSENSE_TEST_BACKENDS=numpy,opencl,warp:cuda:0.
BACKENDS = os.environ.get("GPUSENSE_TEST_BACKENDS", "numpy,opencl,warp:cpu").split(",")

_NAMES = ["auto", "gpu", "cpu", "cuda", *(name for entry in ENTRIES for name in entry.selections)]
# The error of a selection string that names no device.
NO_SELECTION = f"backend: must be {', '.join(map(repr, _NAMES[:-1]))} or {_NAMES[-1]!r}, got {{!r}}".format

# Errors of devices without float64.
NO_FLOAT64 = re.compile(r"which has no float64|computes in float64, which .* does not have")


def lacks_float64() -> bool:
    """Return whether a tested device has no float64."""
    return any(not get_backend(name).info.float64 for name in BACKENDS)


def required(feature: str) -> bool:
    """Return whether GPUSENSE_REQUIRE, a comma-separated list, requires a feature."""
    return feature in [word.strip() for word in os.environ.get("GPUSENSE_REQUIRE", "").split(",")]


def skip_or_fail(feature: str, reason: str) -> None:
    """Skip the test, or fail it if the feature is required."""
    if required(feature):
        pytest.fail(reason)
    pytest.skip(reason)


def present(selection: str) -> str:
    """Return the tested selection string of a backend's name or selection; skip the test if it is absent."""
    chosen = next((name for name in BACKENDS if name.split(":")[0] == selection), selection)
    try:
        get_backend(chosen)
    except ValueError as error:
        skip_or_fail(chosen.split(":")[0], str(error))
    return chosen


def on_every_backend(*, on_warp: Callable[..., bool], **cases: Iterable[object]) -> pytest.MarkDecorator:
    """Parametrize a test over backends and cases; Warp, which compiles each set of flags, gets only some."""
    chosen = [
        (selection, *case)
        for selection, case in itertools.product(BACKENDS, itertools.product(*cases.values()))
        if not selection.startswith("warp") or on_warp(**dict(zip(cases, case, strict=True)))
    ]
    return pytest.mark.parametrize(("backend", *cases), chosen, indirect=["backend"])
