"""Test extreme sizes and levels: 100 000 beams, 10 000 000 particles, maps of 400 million cells, log p of -1e9.

    python bench/accuracy/extreme.py --backend opencl --backend warp:cpu --output bench/results/extreme-cpu
    python bench/accuracy/extreme.py --full --part sizes               # sizes meant for a GPU; nothing is left out

Parts: *sizes* has long scans and large clouds; *products* weights without a shift, as of nav2 and Beluga; *maps*
large grids with a local and a global cloud; *levels* log-likelihoods around -1e9. The script prints tables and writes
JSON. The exit code is 1 if a log p is not finite, weights do not sum to 1 within 1e-6, an error exceeds its bound, or
bits of ranges differ from NumPy's.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import math
import resource
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.evaluation.replay import Recorder, replay
from gpusense.evaluation.tolerances import differing, per_scan
from gpusense.evaluation.worlds import building, cloud_around, cloud_uniform, free_pose, simulate_scan

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import make_parser, note, parse, publish, table, table_line

RANGE_MAX, SIGMA, FARTHEST = 30.0, 0.2, 2.0  # metres; the last two are nav2's defaults for its field
SIZES, LARGER = ((1_000, 100_000), (1_000_000, 1_000), (10_000_000, 4)), ((10_000, 100_000), (10_000_000, 60))
PRODUCTS = (30, 360, 1_000, 100_000)
# Rates that every processor exceeds [particle-beams / s] (beam model, field), and the longest run without --full [s].
SPEED, LONGEST = {"opencl": (6e6, 6e7), "warp": (3e6, 3e7), "numpy": (4e5, 1.5e7)}, 200.0
BEAM, FIELD = "beam model", "field"
MODELS: dict[str, tuple[Callable[..., Any], Any]] = {
    BEAM: (gs.BeamModel, gs.BeamParameters()),
    FIELD: (gs.LikelihoodFieldModel, gs.LikelihoodFieldParameters(0.5, 0.0, 0.5, SIGMA, FARTHEST)),
}
Row = dict[str, Any]


class Scene:
    """A building of 50 m x 50 m, scans simulated in it and clouds, all from one seed."""

    def __init__(self, seed: int) -> None:
        self.seed, self.grid = seed, building(seed, (50.0, 50.0))
        self.pose = free_pose(self.grid, np.random.default_rng(seed))

    def scan(self, beams: int) -> tuple[gs.Scanner, np.ndarray, int]:
        """Draw a scan: the scanner, its readings, and the number of ranges among them."""
        scanner, rng = around(beams), np.random.default_rng((self.seed, beams))
        ranges = simulate_scan(self.grid, scanner, self.pose, gs.BeamParameters(), rng)
        return scanner, ranges, int(np.count_nonzero(np.isfinite(ranges)))

    def cloud(self, kind: str, particles: int) -> np.ndarray:
        """Draw particles around the pose of the scan, or all over the building."""
        rng, local = np.random.default_rng((self.seed, particles)), kind == "tracking"
        return cloud_around(self.pose, particles, 0.3, 0.1, rng) if local else cloud_uniform(self.grid, particles, rng)


def around(beams: int) -> gs.Scanner:
    """Return a scanner whose field of view is a full circle."""
    step = 2 * math.pi / beams
    return gs.Scanner.uniform(angle_min=-math.pi, angle_increment=step, count=beams, range_max=RANGE_MAX)


def weighed(log_p: np.ndarray) -> Row:
    """Return statistics of log-likelihoods and of their normalised weights."""
    row = {"finite": int(np.count_nonzero(np.isfinite(log_p))), "least": float(log_p.min()), "most": float(log_p.max())}
    made = gs.normalize_weights(log_p)
    apart, zero = abs(math.fsum(made.weights) - 1), int(np.count_nonzero(made.weights == 0))
    row |= {"sum_apart": apart, "effective": made.effective_sample_size, "zero_weights": zero}
    return {**row, "ok": row["finite"] == len(log_p) and apart <= 1e-6 and not made.degenerate}


def judged(make: Callable[..., Any], backend: str, poses: np.ndarray, ranges: np.ndarray, found: np.ndarray) -> Row:
    """Score a few particles again; return errors against float64 on the same rounded inputs, and bits that differ."""
    recorder = Recorder(get_backend(backend))
    again, _ = make(backend=recorder).log_likelihood(poses, ranges, per_beam=True)
    truth, parts = replay(launch := recorder.launches[0])
    error, bound = (
        np.abs(found - truth),
        per_scan(parts, found.dtype, fixed=float(launch.values["score"].constant_term)),
    )
    share, bits = float((error / bound).max()), differing(again, found)
    row = {"checked": len(poses), "error": float(error.max()), "bound_share": share, "other_bits": bits}
    return {**row, "ok": share <= 1 and bits == 0}


def sizes(backend: str, precision: str, arguments: argparse.Namespace) -> Iterator[Row]:
    """Yield long scans and large clouds."""
    scene, info = Scene(arguments.seed), get_backend(backend).info
    for particles, beams in SIZES + (LARGER if arguments.full else ()):
        scanner, ranges, hits = scene.scan(beams)
        poses = scene.cloud("tracking", particles)
        for index, name in enumerate((BEAM, FIELD)):
            row = {"model": name, "particles": particles, "beams": beams, "hits": hits}
            expected = particles * hits / SPEED[info.backend][index]
            if info.kind == "cpu" and expected > LONGEST and not arguments.full:
                yield {**row, "left_out": f"takes up to {expected / 60:.0f} minutes on {backend}; --full runs it"}
                continue
            kind, parameters = MODELS[name]
            make = functools.partial(kind, scene.grid, scanner, parameters, precision=precision)
            model, few = make(backend=backend), poses[: 8 if beams > 10_000 else 200]
            model.log_likelihood(few[:1], ranges)
            begin = time.perf_counter()
            log_p = model.log_likelihood(poses, ranges)
            seconds = time.perf_counter() - begin
            made, found = weighed(log_p), judged(make, backend, few, ranges, log_p[: len(few)])
            row |= {"seconds": seconds, "rate": particles * hits / seconds}
            yield {**row, **made, **found, "ok": made["ok"] and found["ok"]}


def products(backend: str, precision: str, arguments: argparse.Namespace) -> Iterator[Row]:
    """Yield how many of 1000 weights are exactly 0 as ``exp(sum of logs)``, the form of nav2_amcl and Beluga."""
    scene, particles = Scene(arguments.seed), 1_000
    for beams, (name, (kind, parameters)) in itertools.product(PRODUCTS, MODELS.items()):
        scanner, ranges, hits = scene.scan(beams)
        model, chunk = kind(scene.grid, scanner, parameters, backend=backend, precision=precision), 10_000_000 // beams
        for cloud in ("tracking", "global"):
            poses, pieces = scene.cloud(cloud, particles), []
            for begin in range(0, particles, chunk):
                log_p, parts = model.log_likelihood(poses[begin : begin + chunk], ranges, per_beam=True)
                pieces.append((log_p, np.exp(parts.astype(np.float64).sum(axis=1))))
            log_p, raw = (np.concatenate(column) for column in zip(*pieces, strict=True))
            row = {"model": name, "cloud": cloud, "particles": particles, "beams": beams, "hits": hits}
            yield {**row, "exp_of_sum_zero": int(np.count_nonzero(raw == 0)), **weighed(log_p)}


def rooms(side: int, rng: np.random.Generator) -> np.ndarray:
    """Draw rooms of 160 x 160 cells with doors and a pillar each: (side, side) cells, 100 where occupied."""
    cells, corners = np.zeros((side, side), np.int8), np.arange(0, side, 160)
    cells[corners], cells[:, corners] = 100, 100
    for row in corners:
        for col, (door, up, right, size) in zip(corners, rng.integers(20, 120, (len(corners), 4)), strict=True):
            cells[row, col + door : col + door + 20] = 0
            cells[row + door : row + door + 20, col] = 0
            cells[row + up : row + up + size // 8, col + right : col + right + size // 8] = 100
    return cells


def cut(grid: gs.OccupancyGrid, pose: np.ndarray) -> gs.OccupancyGrid:
    """Crop a map to the reach of a scan from a pose; multiples of 1 / 16 m need no rounding."""
    reach, col, row = math.ceil((RANGE_MAX + FARTHEST) / grid.resolution) + 4, *(pose[:2] // grid.resolution)
    low_row, low_col = max(int(row) - reach, 0), max(int(col) - reach, 0)
    cells = grid.cells[low_row : int(row) + reach, low_col : int(col) + reach]
    return gs.OccupancyGrid(cells, grid.resolution, (low_col * grid.resolution, low_row * grid.resolution, 0.0))


def maps(backend: str, precision: str, arguments: argparse.Namespace) -> Iterator[Row]:
    """Yield large grids with a local and a global cloud; NumPy checks some particles on a crop around each."""
    for side in arguments.side or [20_000]:
        rng, metres = np.random.default_rng(arguments.seed), side / 16
        grid, scanner = gs.OccupancyGrid(rooms(side, rng), 1 / 16), around(60)
        place = np.array([(side // 320 * 160 + 80) / 16, (side // 320 * 160 + 10) / 16, 0.5])
        ranges = gs.RayCaster(cut(grid, place), RANGE_MAX, backend="numpy").cast(place[None], scanner.bearings)[0]
        local = cloud_around(place, 10_000, 0.3, 0.1, rng)
        everywhere = rng.uniform((0, 0, -math.pi), (metres, metres, math.pi), (10_000, 3))
        for name, (kind, parameters) in MODELS.items():
            model = kind(grid, scanner, parameters, backend=backend, precision=precision)
            for cloud, poses in (("local", local), ("global", everywhere)):
                row = {"model": name, "cells": f"{side} x {side}", "cloud": cloud, "particles": len(poses), "beams": 60}
                begin = time.perf_counter()
                try:
                    log_p = model.log_likelihood(poses, ranges)
                except (MemoryError, ValueError) as error:
                    yield {**row, "outcome": f"{type(error).__name__}: {error}"}
                    continue
                seconds, made, bits, worst = time.perf_counter() - begin, weighed(log_p), 0, 0.0
                window = model._pipeline.map.window
                part = "the whole map" if window.cells == side * side else f"cropped to {window.rows} x {window.cols}"
                for pose, found in zip(poses[:20, None], log_p[:20], strict=True):
                    small = kind(cut(grid, pose[0]), scanner, parameters, backend="numpy", precision=precision)
                    worst = max(worst, abs(float(found - small.log_likelihood(pose, ranges)[0])))
                    if name == BEAM:
                        bits += differing(model.expected_ranges(pose), small.expected_ranges(pose))
                ok = made["ok"] and bits == 0 and worst <= 2e-3
                yield {**row, **made, "outcome": part, "seconds": seconds, "error": worst, "other_bits": bits, "ok": ok}


def levels(backend: str, precision: str, arguments: argparse.Namespace) -> Iterator[Row]:
    """Yield scans of 1000 beams under p_hit alone, with a sigma_hit that makes log p about -1e9."""
    scene = Scene(arguments.seed)
    scanner, ranges, _ = scene.scan(1_000)
    narrow = cloud_around(scene.pose, 1_000, 1e-9, 1e-10, np.random.default_rng(scene.seed))
    clouds = {"tracking": scene.cloud("tracking", 1_000), "narrow": narrow}
    for (name, (kind, parameters)), (cloud, poses) in itertools.product(MODELS.items(), clouds.items()):
        others, sigma = {"z_short": 0, "z_max": 0} if name == BEAM else {}, 1e-3
        for _ in range(2):
            p = parameters.replace(z_hit=1, z_rand=0, sigma_hit=sigma, **others)
            truth = kind(scene.grid, scanner, p, backend="numpy", precision="float64").log_likelihood(poses, ranges)
            sigma *= math.sqrt(-float(np.median(truth)) / 1e9)
        log_p = kind(scene.grid, scanner, p, backend=backend, precision=precision).log_likelihood(poses, ranges)
        median, relative = float(np.median(log_p)), float(np.max(np.abs(log_p - truth) / -truth))
        moved = np.abs(gs.normalize_weights(log_p).weights - gs.normalize_weights(truth).weights).sum() / 2
        row = {"model": name, "cloud": cloud, "particles": len(poses), "sigma_hit": p.sigma_hit, "median": median}
        row |= {"exp_is_zero": int(np.count_nonzero(np.exp(log_p.astype(np.float64)) == 0))}
        row |= {"spacing": float(np.spacing(-log_p[0])), "relative": relative, "weight_moved": float(moved)}
        yield {**row, **weighed(log_p)}


PARTS = {"sizes": sizes, "products": products, "maps": maps, "levels": levels}
COLUMNS = {
    "sizes": "model particles beams hits seconds rate finite sum_apart effective error bound_share other_bits left_out",
    "products": "model cloud beams hits effective zero_weights sum_apart exp_of_sum_zero",
    "maps": "model cells cloud outcome seconds finite sum_apart effective error other_bits",
    "levels": "model cloud sigma_hit median finite sum_apart effective spacing relative weight_moved exp_is_zero",
}


def columns(part: str) -> list[str]:
    """Return the columns of a part's table."""
    return ["backend", "precision", *COLUMNS[part].split()]


def cells(part: str, row: Row) -> list[str]:
    """Format the cells of a row."""
    shown = (row.get(name, "") for name in columns(part))
    return [f"{value:.4g}" if isinstance(value, float) else str(value) for value in shown]


def main() -> int:
    """Run the parts and publish their tables."""
    parser = make_parser(__doc__, backend="kernels")
    parser.add_argument("--precision", action="append", choices=("float32", "float64"), help="default: float32")
    parser.add_argument("--part", action="append", choices=tuple(PARTS), help="default: all")
    parser.add_argument("--side", action="append", type=int, help="rows and columns of a large map; default: 20000")
    parser.add_argument("--full", action="store_true", help="sizes meant for a GPU; leave nothing out")
    arguments = parse(parser)
    devices = [get_backend(name).info for name in arguments.backend]
    rows: dict[str, list[Row]] = {part: [] for part in arguments.part or PARTS}
    begin = time.perf_counter()
    for part, kept in rows.items():
        for device in devices:
            both = ["float32", "float64"] if part == "levels" and device.float64 else ["float32"]
            for precision in arguments.precision or both:
                for row in PARTS[part](device.selection, precision, arguments):
                    kept.append({"backend": device.selection, "precision": precision, **row})
                    note(table_line(cells(part, kept[-1])))
    seconds, peak = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    tables = [
        f"### {part}\n\n" + table(columns(part), (cells(part, row) for row in kept)) for part, kept in rows.items()
    ]
    report = {"devices": [asdict(d) for d in devices], "seconds": seconds, "peak_memory": peak, "rows": rows}
    remark = f"{seconds:.0f} s, at most {peak / 1e9:.1f} GB."
    publish(__file__, arguments, "\n\n".join(tables), report, remark)
    return int(not all(row.get("ok", True) for kept in rows.values() for row in kept))


if __name__ == "__main__":
    sys.exit(main())
