"""Calls that take poses as arrays of any library, and ``out=`` for their results."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gpusense as gs

METHODS = ("log_likelihood", "field", "expected_ranges", "cast")


def result_call(
    method: str, backend: Any, grid: gs.OccupancyGrid, scanner: gs.Scanner, scan: Any
) -> tuple[Callable[..., Any], tuple[int, ...]]:
    """Return the call of a method with poses and ``out=``, and the shape of its result per pose."""
    if method == "cast":
        caster = gs.RayCaster(grid, scanner.range_max, backend=backend)
        return lambda poses, **options: caster.cast(poses, scanner.bearings, **options), (scanner.count,)
    model = (gs.LikelihoodFieldModel if method == "field" else gs.BeamModel)(grid, scanner, backend=backend)
    if method == "expected_ranges":
        return model.expected_ranges, (scanner.count,)
    return lambda poses, **options: model.log_likelihood(poses, scan, **options), ()
