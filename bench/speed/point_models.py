"""Measure models without a scan: landmarks, position fixes, headings, ranges to beacons, bumpers; speed and error.

    python bench/speed/point_models.py                                            # every device present
    python bench/speed/point_models.py --backend opencl --what landmarks --landmarks 100 --cloud tracking
    python bench/speed/point_models.py --backend opencl --what absolute --particles 100000 --output NAME

*Landmarks*: one in every 16 m2, 100 in a square of 40 m; features are the nearest landmarks within 20 m of a pose, with
    noise. Known: the landmark of each feature is given; nearest: it is the likeliest one. The other kinds differ from
    nearest as their names say; with a field of view all features lie in it, and joint has at most 5. Clouds are around
    the pose (tracking) or all over the map (global). *Absolute*: poses are all over the built-in building, moved to UTM
    coordinates; a reading is a fix, a heading, a range, or a segment of a bumper.

Rates are of whole calls with NumPy in and out, and of their launches alone. Errors are of log p against the float64
reference on the first particles, in eps (1 + |log p|) of float32 and a reading; a larger one than 16 ends the run.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.evaluation.worlds import building, cloud_uniform

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import (
    MOST_EPS,
    Recorder,
    add_repeats,
    best,
    make_parser,
    note,
    one_by_one,
    parse,
    publish,
    table,
    table_line,
    waited,
)

CHECKED = 200
CLOUDS = ("tracking", "global")
# Square metres of the map for each landmark.
EACH = 16.0
# Kinds of calls of the landmark model, with their changes of parameters and model.
LANDMARKS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "known": ({}, {}),
    "nearest": ({}, {}),
    "ranges only": ({"sigma_bearing": None}, {}),
    "bearings only": ({"sigma_range": None}, {}),
    "signatures": ({"sigma_signature": 0.3}, {}),
    "field of view": ({"field_of_view": 2.0}, {}),
    "sum": ({}, {"association": "sum"}),
    "joint": ({}, {"association": "joint"}),
    "negative information": ({}, {"negative": True}),
    "associate": ({}, {}),
}
ABSOLUTE = ("position fix", "heading", "beacons", "bumper")
# The building's origin in UTM coordinates [m, m, rad].
PLACE = (5e5, 5e6, 0.3)
SQUARE = [(0.2, 0.2), (-0.2, 0.2), (-0.2, -0.2), (0.2, -0.2)]
COLUMNS = (
    "backend", "device", "what", "particles x readings", "M particle-readings/s", "launches alone",
    "ms a call (median)", "first call s", "error, eps (1 + \\|log p\\|)",
)  # fmt: skip


@dataclass(frozen=True)
class Job:
    """A row to measure."""

    what: str
    make: Callable[..., Any]
    call: Callable[[Any, np.ndarray], np.ndarray]
    poses: np.ndarray
    readings: int


# ---- landmarks


@dataclass(frozen=True)
class Landmarks:
    """A map, the features seen within 20 m with the landmark of each, nearest first, and clouds of particles."""

    landmarks: gs.LandmarkMap
    features: np.ndarray
    seen: np.ndarray
    clouds: dict[str, np.ndarray]


def landmark_scene(count: int, particles: int, seed: int) -> Landmarks:
    """Draw a map, the features of a pose in its middle, and clouds around it and all over the map."""
    rng = np.random.default_rng(seed)
    side = float(np.sqrt(EACH * count))
    xy = rng.uniform(-side / 2, side / 2, (count, 2))
    pose = np.array([0.5, -0.5, 0.3])
    away = xy - pose[:2]
    distance = np.hypot(*away.T)
    seen = np.argsort(distance)[: np.count_nonzero(distance < 20.0)]
    features = np.stack([distance[seen], np.arctan2(away[seen, 1], away[seen, 0]) - pose[2], seen % 7], axis=1)
    features += rng.normal(0, (0.2, 0.05, 0.2), features.shape)
    features[:, 0] = np.clip(features[:, 0], 0.01, 20.0)
    clouds = {
        "tracking": pose + rng.normal(0, (0.3, 0.3, 0.1), (particles, 3)),
        "global": rng.uniform(-1, 1, (particles, 3)) * (side / 2, side / 2, np.pi),
    }
    return Landmarks(gs.LandmarkMap(xy, np.arange(count) % 7), features, seen, clouds)


def landmark_job(scene: Landmarks, what: str, cloud: str, most: int) -> Job:
    """Return the row of one kind of call."""
    changes, options = LANDMARKS[what]
    parameters = gs.LandmarkParameters(**changes)
    bearing = scene.features[:, 1]
    in_view = np.abs(np.arctan2(np.sin(bearing), np.cos(bearing))) < parameters.field_of_view / 2
    chosen = np.flatnonzero(in_view)[: min(most, 5) if what == "joint" else most]
    features = scene.features[chosen, : 3 if parameters.sigma_signature else 2]
    known = scene.seen[chosen] if what == "known" else None

    def make(**where: Any) -> gs.LandmarkModel:
        return gs.LandmarkModel(scene.landmarks, parameters, **options, **where)

    def call(model: gs.LandmarkModel, poses: np.ndarray) -> np.ndarray:
        if what == "associate":
            return model.associate(poses, features)[1].sum(axis=1)
        return model.log_likelihood(poses, features, known)

    label = f"{what}, {len(scene.landmarks)} landmarks, {cloud}"
    return Job(label, make, call, scene.clouds[cloud], len(features))


# ---- absolute sensors


def absolute_models(grid: gs.OccupancyGrid, xy: np.ndarray) -> dict[str, tuple[Callable[..., Any], tuple[Any, ...]]]:
    """Return a function that makes each model, and its arguments besides the poses."""
    x, y = float(xy[0, 0]), float(xy[0, 1])
    region = (x - 500, y - 500, x + 500, y + 500)
    fix, mounted = gs.PositionParameters(sigma=2.0), dict(z_hit=0.9, z_rand=0.1, region=region, mount=(0.2, 0.1))
    normal = gs.HeadingParameters(sigma=0.1)
    von_mises = gs.HeadingParameters(kind="von_mises", z_hit=0.9, z_rand=0.1)
    made: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {
        "position fix": (lambda **where: gs.PositionModel(fix, **where), ((x, y),)),
        "position fix, outliers and mount": (
            lambda **where: gs.PositionModel(fix.replace(**mounted), **where), ((x, y),),
        ),
        "heading, wrapped normal": (lambda **where: gs.HeadingModel(normal, **where), (1.0,)),
        "heading, von Mises and outliers": (lambda **where: gs.HeadingModel(von_mises, **where), (1.0,)),
    }  # fmt: skip
    ranges = np.full(len(xy), 12.0)
    for kind in ("normal", "student_t", "mixture"):
        p = gs.BeaconParameters(kind=kind, range_max=100.0)
        made[f"beacons, {kind}"] = (lambda p=p, **where: gs.BeaconModel(xy, p, **where), (ranges,))
    made["bumper, circle"] = (lambda **where: gs.BumperModel(grid, 0.25, **where), (True,))
    made["bumper, square of 4 segments"] = (
        lambda **where: gs.BumperModel(grid, SQUARE, segments=[0, 1, 2, 3], **where), ([True, False, False, False],),
    )  # fmt: skip
    return made


def absolute_jobs(arguments: argparse.Namespace) -> Iterator[Job]:
    """Yield the rows of the chosen sensors."""
    rng = np.random.default_rng(arguments.seed)
    flat = building(arguments.seed)
    grid = gs.OccupancyGrid(flat.cells, flat.resolution, origin=PLACE)
    poses = cloud_uniform(grid, arguments.particles, rng)
    xy = poses[0, :2] + rng.uniform(-20, 20, (arguments.beacons, 2))
    for name, (make, measured) in absolute_models(grid, xy).items():
        if name.split(",")[0] in arguments.what:
            readings = int(np.size(measured[0])) if name.startswith(("beacons", "bumper")) else 1

            def call(model: Any, poses: np.ndarray, measured: tuple[Any, ...] = measured) -> np.ndarray:
                return model.log_likelihood(poses, *measured)

            yield Job(name, make, call, poses, readings)


# ---- all


def jobs(arguments: argparse.Namespace) -> Iterator[Job]:
    """Yield all chosen rows."""
    kinds = [kind for kind in LANDMARKS if kind in arguments.what]
    for count in arguments.landmarks if kinds else ():
        scene = landmark_scene(count, arguments.particles, arguments.seed)
        for cloud in arguments.cloud or CLOUDS:
            for kind in kinds:
                yield landmark_job(scene, kind, cloud, arguments.features)
    yield from absolute_jobs(arguments)


def measure(backend: str, job: Job, arguments: argparse.Namespace) -> dict[str, Any]:
    """Measure times and error of a row."""
    device = Recorder(get_backend(backend))
    start = time.perf_counter()
    model = job.make(backend=device)
    found = job.call(model, job.poses)
    first = time.perf_counter() - start
    launches = device.launches_of(lambda: job.call(model, job.poses))
    least, median = best(lambda: job.call(model, job.poses), arguments.repeats, arguments.seconds)
    alone, _ = best(waited(device, one_by_one(launches)), arguments.repeats, arguments.seconds)
    exact = job.call(job.make(backend="numpy", precision="float64"), job.poses[:CHECKED])
    size = job.readings * np.finfo(np.float32).eps * (1 + np.abs(exact) / job.readings)
    error = float(np.max(np.abs(found[:CHECKED] - exact) / size))
    if not error < MOST_EPS:
        raise RuntimeError(f"{backend}, {job.what}: the error is {error:.3g} eps (1 + |log p|), so no time counts")
    work = len(job.poses) * job.readings
    return {
        "backend": device.info.selection, "device": device.info.name, "what": job.what, "particles": len(job.poses),
        "readings": job.readings, "first_s": first, "steady_s": least, "median_s": median, "rate": work / least,
        "launches": len(launches), "launch_s": alone, "launch_rate": work / alone, "error": error,
    }  # fmt: skip


def cells(r: dict[str, Any]) -> list[str]:
    """Format the cells of a row."""
    return [
        r["backend"], r["device"], r["what"], f"{r['particles']} x {r['readings']}", f"{r['rate'] / 1e6:.4g}",
        f"{r['launch_rate'] / 1e6:.4g}", f"{r['steady_s'] * 1e3:.3g} ({r['median_s'] * 1e3:.3g})",
        f"{r['first_s']:.2f}", f"{r['error']:.2f}",
    ]  # fmt: skip


def main() -> int:
    """Measure and write."""
    groups = {"landmarks": list(LANDMARKS), "absolute": list(ABSOLUTE), "all": [*LANDMARKS, *ABSOLUTE]}
    parser = make_parser(__doc__)
    parser.add_argument(
        "--what", nargs="+", choices=[*groups["all"], *groups], default=["known", "nearest", "absolute"],
        help="kinds of calls, or groups of them; default: known nearest absolute",
    )  # fmt: skip
    parser.add_argument("--landmarks", type=int, action="append", help="default: 20, 100, 10 000 and 100 000")
    parser.add_argument("--cloud", action="append", choices=CLOUDS, help="of landmarks; default: both")
    parser.add_argument("--particles", type=int, default=100_000)
    parser.add_argument("--features", type=int, default=10)
    parser.add_argument("--beacons", type=int, default=8)
    add_repeats(parser, 20, 3.0)
    arguments = parse(parser)
    arguments.landmarks = arguments.landmarks or [20, 100, 10_000, 100_000]
    arguments.what = {kind for name in arguments.what for kind in groups.get(name, [name])}
    rows = []
    for job in jobs(arguments):
        for backend in arguments.backend:
            rows.append(measure(backend, job, arguments))
            note(table_line(cells(rows[-1])))
    publish(__file__, arguments, table(COLUMNS, map(cells, rows)), {"rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
