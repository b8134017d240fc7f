"""Make the interactive figures of the site; its build calls ``write_pages``.

Each is one page that fetches nothing: the sources in ``docs/figures``, and data out of gpusense. Values of gpusense's
NumPy backend are among the data, with which the script of the page compares its own.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs

SOURCES = Path(__file__).parent / "figures"
RANGE_MAX = 5.0
# Weights of hit, short, max and rand, sigma_hit [m], lambda_short [1/m], and z* [m].
SETTINGS = (
    (0.6, 0.2, 0.1, 0.1, 0.15, 0.6, 3.0),
    (0.25, 0.25, 0.25, 0.25, 1.0, 4.0, 0.1),
    (1.0, 0.0, 0.0, 0.0, 0.5, 0.0, 4.9),
    (0.0, 0.9, 0.0, 0.1, 0.02, 0.0, 2.0),
    (0.1, 0.6, 0.2, 0.1, 0.3, 0.05, 4.0),
)


def wall() -> gs.OccupancyGrid:
    """Return a map with a wall at x = 5 m."""
    cells = np.zeros((1, 101), dtype=np.int8)
    cells[0, 100] = 100
    return gs.OccupancyGrid(cells, resolution=0.05)


def beam_density(parameters: gs.BeamParameters, expected: float, z: np.ndarray) -> np.ndarray:
    """Return p(z | z*) of readings [1/m].

    Args:
        parameters: Parameters of the mixture.
        expected: Range to the wall z* [m].
        z: (N,) readings below ``RANGE_MAX`` [m].
    """
    scanner = gs.Scanner(np.zeros(z.size), range_max=RANGE_MAX)
    model = gs.BeamModel(wall(), scanner, parameters, precision="float64", backend="numpy")
    return np.exp(model.log_likelihood([(5.0 - expected, 0.025, 0.0)], z, per_beam=True)[1][0])


def beam_data() -> dict[str, Any]:
    """Return densities of some settings of the sliders."""
    z = np.array([0.0, 0.05, 0.7, 1.9, 2.9, 3.02, 3.9, 4.7, 4.99])
    rows = []
    for *weights, sigma, decay, expected in SETTINGS:
        names = ("z_hit", "z_short", "z_max", "z_rand")
        values = dict(zip(names, weights, strict=True)) | {"sigma_hit": sigma, "lambda_short": decay}
        p = beam_density(gs.BeamParameters(**values), expected, z)
        rows.append({"parameters": values, "expected": expected, "z": z.tolist(), "p": p.tolist()})
    return {"range_max": RANGE_MAX, "densities": rows}


def scan_data() -> dict[str, Any]:
    """Return a map, a scan, and ranges and likelihoods at some poses."""
    grid = gs.worlds.building(size=(14.0, 10.0), resolution=0.1, seed=4)
    scanner = gs.Scanner(np.radians(np.arange(-120, 121, 5)), range_max=8.0)
    random = np.random.default_rng(11)
    truth = np.array(gs.worlds.free_pose(grid, random))
    beam = gs.BeamParameters(z_hit=0.75, z_short=0.1, z_max=0.05, z_rand=0.1, sigma_hit=0.15)
    field = gs.LikelihoodFieldParameters(sigma_hit=0.15)
    drawn = gs.BeamModel(grid, scanner, beam.replace(sigma_hit=0.03), backend="numpy").sample(truth[None])[0]
    ranges = np.round(drawn.astype(np.float64), 3)
    poses = np.round(np.vstack([truth, gs.worlds.cloud_uniform(grid, 11, random)]), 3)
    caster = gs.RayCaster(grid, range_max=scanner.range_max, precision="float64", backend="numpy")
    expected = caster.cast(poses, scanner.bearings)
    scores = [
        kind(grid, scanner, parameters, precision="float64", backend="numpy").log_likelihood(poses, ranges)
        for kind, parameters in ((gs.BeamModel, beam), (gs.LikelihoodFieldModel, field))
    ]
    cells = (np.asarray(grid.cells) == 100).astype(int)
    return {
        "map": {
            "cols": cells.shape[1], "rows": cells.shape[0], "resolution": grid.resolution,
            "cells": "".join(map(str, cells.ravel())),
        },
        "scan": {
            "bearings": scanner.bearings.tolist(), "range_max": scanner.range_max,
            "ranges": [z if z < scanner.range_max else None for z in ranges.tolist()],
        },
        "beam": beam.to_dict(), "field": field.to_dict(), "truth": poses[0].tolist(), "start": poses[1].tolist(),
        "poses": [
            {"pose": pose.tolist(), "expected": row.tolist(), "log_beam": float(one), "log_field": float(other)}
            for pose, row, one, other in zip(poses, expected, *scores, strict=True)
        ],
    }  # fmt: skip


def em_data() -> dict[str, Any]:
    """Return readings of a wall, and the parameters after some steps of the book's EM."""
    expected = 3.0
    truth = gs.BeamParameters(z_hit=0.5, z_short=0.25, z_max=0.15, z_rand=0.1, sigma_hit=0.12, lambda_short=0.8)
    model = gs.BeamModel(wall(), gs.Scanner(np.zeros(400), range_max=RANGE_MAX), truth, backend="numpy")
    ranges = np.round(model.sample([(5.0 - expected, 0.025, 0.0)], seed=1)[0].astype(np.float64), 3)
    start = gs.BeamParameters(z_hit=0.25, z_short=0.25, z_max=0.25, z_rand=0.25, sigma_hit=1.0, lambda_short=0.1)
    steps = []
    for count in (1, 2, 5, 20):
        fit = gs.fit_beam_parameters(
            ranges, np.full(ranges.size, expected), RANGE_MAX, method="em-book", initial=start, max_iterations=count,
            tolerance=1e-300, backend="numpy", precision="float64",
        )  # fmt: skip
        values = {"parameters": fit.parameters.to_dict(), "log_likelihood": float(fit.trace[-1])}
        steps.append({"count": count} | values)
    kept = [z if z < RANGE_MAX else None for z in ranges.tolist()]
    return {
        "range_max": RANGE_MAX, "expected": expected, "ranges": kept, "start": start.to_dict(),
        "truth": truth.to_dict(), "steps": steps,
    }  # fmt: skip


DATA = {"beam": beam_data, "scan": scan_data, "em": em_data}


def page(name: str) -> str:
    """Return the page of a figure."""
    parts = {
        "style": (SOURCES / "style.css").read_text(encoding="utf-8"),
        "model": (SOURCES / "model.js").read_text(encoding="utf-8"),
        "data": json.dumps(DATA[name](), allow_nan=False),
    }
    text = (SOURCES / f"{name}.html").read_text(encoding="utf-8")
    for mark, part in parts.items():
        text = text.replace(f"/*{{{mark}}}*/", part)
    return text


def write_pages(folder: Path) -> None:
    """Write the pages into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in DATA:
        (folder / f"{name}.html").write_text(page(name), encoding="utf-8")
