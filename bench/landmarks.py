"""Speed and error of the landmark model on the devices of this machine.

    python bench/landmarks.py                                        # every device present
    python bench/landmarks.py --backend opencl --landmarks 100 --particles 100000 --output bench/results/name
    python bench/landmarks.py --backend opencl --landmarks 100 --what all --cloud tracking

Writes a Markdown table and a JSON file with machine, sizes, times, errors and the command. There is a landmark in every
16 m2, 100 in a square of 40 m; features are those nearest to a pose within 20 m, with noise. Known: it is given which
landmark each feature is; nearest: the likeliest of all. The others (``--what all``) are as nearest, but for what their
names say; those with a field of view have features in it, joint at most 5. Clouds are around the pose (tracking) or
all over the map (global). Rates are of whole calls with NumPy in and out, and of their launches alone. Errors are of
log p against the float64 reference on the first particles, in eps (1 + |log p|) of float32 and a feature.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from speed import Recorder, best, publish

import gpusense as gs
from gpusense.backends import get_backend

EACH = 16.0
CHECKED = 200
# Names and what they change in parameters and model.
WHAT: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
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


@dataclass(frozen=True)
class Scene:
    """A map, what is seen of the landmarks within 20 m, the nearest first, and clouds of particles."""

    landmarks: gs.LandmarkMap
    features: np.ndarray
    seen: np.ndarray
    clouds: dict[str, np.ndarray]


def make_scene(count: int, particles: int, seed: int) -> Scene:
    """A map, what is seen from a pose in its middle, and clouds around it and all over the map."""
    rng = np.random.default_rng(seed)
    side = float(np.sqrt(EACH * count))
    xy = rng.uniform(-side / 2, side / 2, (count, 2))
    pose = np.array([0.5, -0.5, 0.3])
    away = xy - pose[:2]
    distance = np.hypot(*away.T)
    seen = np.argsort(distance)[: np.count_nonzero(distance < 20.0)]
    found = np.stack([distance[seen], np.arctan2(away[seen, 1], away[seen, 0]) - pose[2], seen % 7], axis=1)
    found += rng.normal(0, (0.2, 0.05, 0.2), found.shape)
    found[:, 0] = np.clip(found[:, 0], 0.01, 20.0)
    clouds = {
        "tracking": pose + rng.normal(0, (0.3, 0.3, 0.1), (particles, 3)),
        "global": rng.uniform(-1, 1, (particles, 3)) * (side / 2, side / 2, np.pi),
    }
    return Scene(gs.LandmarkMap(xy, np.arange(count) % 7), found, seen, clouds)


def calls_of(scene: Scene, what: str, cloud: str, features: int) -> tuple[Any, Any, int]:
    """What makes a model, what calls it, and how many features it is given."""
    changes, options = WHAT[what]
    parameters, poses = gs.LandmarkParameters(**changes), scene.clouds[cloud]
    bearing = scene.features[:, 1]
    in_view = np.abs(np.arctan2(np.sin(bearing), np.cos(bearing))) < parameters.field_of_view / 2
    chosen = np.flatnonzero(in_view)[: min(features, 5) if what == "joint" else features]
    given = scene.features[chosen, : 3 if parameters.sigma_signature else 2]
    known = scene.seen[chosen] if what == "known" else None

    def make(**own: Any) -> gs.LandmarkModel:
        return gs.LandmarkModel(scene.landmarks, parameters, **options, **own)

    def call(model: gs.LandmarkModel, count: int | None = None) -> np.ndarray:
        if what == "associate":
            return model.associate(poses[:count], given)[1].sum(axis=1)
        return model.log_likelihood(poses[:count], given, known)

    return make, call, len(given)


def row_of(backend: str, scene: Scene, what: str, cloud: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Times and error of one kind of call on a device.

    Raises:
        RuntimeError: the error is above 16 eps (1 + |log p|), so no time counts.
    """
    make, call, count = calls_of(scene, what, cloud, arguments.features)
    device = Recorder(get_backend(backend))
    model = make(backend=device)
    start = time.perf_counter()
    found = call(model)
    first = time.perf_counter() - start
    launches = device.launches_of(lambda: call(model))

    def again() -> None:
        for launch in launches:
            launch()
        device.synchronize()

    least, median = best(lambda: call(model), arguments.repeats, arguments.seconds)
    alone, _ = best(again, arguments.repeats, arguments.seconds)
    exact = call(make(backend="numpy", precision="float64"), CHECKED)
    size = count * np.finfo(np.float32).eps * (1 + np.abs(exact) / count)
    error = float(np.max(np.abs(found[:CHECKED] - exact) / size))
    if not error < 16:
        raise RuntimeError(f"{backend}, {what}: the error is {error:.3g} eps (1 + |log p|), so no time counts")
    work = len(scene.clouds[cloud]) * count
    return {
        "backend": device.info.selection, "device": device.info.name, "landmarks": len(scene.landmarks),
        "what": what, "cloud": cloud, "particles": len(scene.clouds[cloud]), "features": count,
        "first_s": first, "steady_s": least, "median_s": median, "rate": work / least, "launch_s": alone,
        "launch_rate": work / alone, "error": error,
    }  # fmt: skip


def to_markdown(rows: list[dict[str, Any]]) -> str:
    """The rows as a table."""
    head = (
        "| backend | device | landmarks | which | cloud | particles x features | M particle-features/s | launches "
        "alone | first call s | error, eps (1 + \\|log p\\|) |\n|" + " --- |" * 10
    )
    lines = [
        f"| {r['backend']} | {r['device']} | {r['landmarks']} | {r['what']} | {r['cloud']} | {r['particles']} x "
        f"{r['features']} | {r['rate'] / 1e6:.4g} | {r['launch_rate'] / 1e6:.4g} | {r['first_s']:.2f} "
        f"| {r['error']:.2f} |"
        for r in rows
    ]
    return "\n".join([head, *lines])


def main() -> int:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", action="append", help="selection string; every device present where left out")
    parser.add_argument("--landmarks", type=int, action="append", help="default 20, 100, 10 000 and 100 000")
    parser.add_argument(
        "--what", nargs="+", choices=[*WHAT, "all"], default=["known", "nearest"], help="default: known nearest"
    )
    parser.add_argument("--cloud", action="append", choices=["tracking", "global"], help="both where left out")
    parser.add_argument("--particles", type=int, default=100_000)
    parser.add_argument("--features", type=int, default=10)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=5.0, help="longest time of the repeats of one row")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commit", default="", help="for a copy of the tree that is no git repository")
    parser.add_argument("--output", type=Path, help="path without ending for the .json and .md files")
    arguments = parser.parse_args()
    present = [d.selection for d in gs.devices() if d.available and d.kind != "simulator"]
    chosen = list(WHAT) if "all" in arguments.what else arguments.what
    rows = []
    for backend in arguments.backend or present:
        for count in arguments.landmarks or (20, 100, 10_000, 100_000):
            scene = make_scene(count, arguments.particles, arguments.seed)
            for cloud in arguments.cloud or scene.clouds:
                rows += [row_of(backend, scene, what, cloud, arguments) for what in chosen]
    publish("landmarks.py", arguments, to_markdown(rows), {"rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
