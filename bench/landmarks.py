"""Speed and error of the landmark model on the devices of this machine.

    python bench/landmarks.py                                        # every device present
    python bench/landmarks.py --backend opencl --landmarks 100 --particles 100000 --output bench/results/name

Writes a Markdown table and a JSON file with machine, sizes, times, errors and the command. There is a landmark in every
16 m2, 100 in a square of 40 m; features are those nearest to a pose within 20 m, with noise. Known: it is given which
landmark each feature is; nearest: the likeliest of all. Clouds are around the pose (tracking) or all over the map
(global). Rates are of whole calls with NumPy in and out, and of their launches alone. Errors are of log p against the
float64 reference on the first particles, in eps (1 + |log p|) of float32 and a feature.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from speed import Recorder, best, command_line, machine, write_report

import gpusense as gs
from gpusense.backends import get_backend

EACH = 16.0
CHECKED = 200


def scene(count: int, features: int, particles: int, seed: int) -> tuple[Any, ...]:
    """A map, what is seen from a pose in its middle, the landmarks that it is, and the clouds."""
    rng = np.random.default_rng(seed)
    side = float(np.sqrt(EACH * count))
    xy = rng.uniform(-side / 2, side / 2, (count, 2))
    pose = np.array([0.5, -0.5, 0.3])
    away = xy - pose[:2]
    seen = np.argsort(np.hypot(*away.T))[:features]
    found = np.stack([np.hypot(*away[seen].T), np.arctan2(away[seen, 1], away[seen, 0]) - pose[2]], axis=1)
    found += rng.normal(0, (0.2, 0.05), found.shape)
    found[:, 0] = np.clip(found[:, 0], 0.01, 20.0)
    clouds = {
        "tracking": pose + rng.normal(0, (0.3, 0.3, 0.1), (particles, 3)),
        "global": rng.uniform(-1, 1, (particles, 3)) * (side / 2, side / 2, np.pi),
    }
    return gs.LandmarkMap(xy), found, seen, clouds


def rows_of(backend: str, count: int, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Rows of a device for a number of landmarks."""
    landmarks, features, seen, clouds = scene(count, arguments.features, arguments.particles, arguments.seed)
    rows = []
    for cloud, poses in clouds.items():
        for what, known in (("known", seen), ("nearest", None)):
            device = Recorder(get_backend(backend))
            model = gs.LandmarkModel(landmarks, backend=device)
            start = time.perf_counter()
            found = model.log_likelihood(poses, features, known)
            first = time.perf_counter() - start

            def call(m: Any = model, p: Any = poses, k: Any = known) -> Any:
                return m.log_likelihood(p, features, k)

            device.launches.clear()
            call()
            launches = list(device.launches)

            def again(launches: list[Any] = launches, device: Any = device) -> None:
                for launch in launches:
                    launch()
                device.synchronize()

            least, median = best(call, arguments.repeats, arguments.seconds)
            alone, _ = best(again, arguments.repeats, arguments.seconds)
            truth = gs.LandmarkModel(landmarks, backend="numpy", precision="float64")
            exact = truth.log_likelihood(poses[:CHECKED], features, known)
            size = len(features) * np.finfo(np.float32).eps * (1 + np.abs(exact) / len(features))
            error = float(np.max(np.abs(found[:CHECKED] - exact) / size))
            if not error < 16:
                raise RuntimeError(f"{backend}: the error is {error:.3g} eps (1 + |log p|), so no time counts")
            rows.append({
                "backend": device.info.selection, "device": device.info.name, "landmarks": count, "what": what,
                "cloud": cloud, "particles": len(poses), "features": len(features), "first_s": first,
                "steady_s": least, "median_s": median, "rate": len(poses) * len(features) / least,
                "launch_s": alone, "launch_rate": len(poses) * len(features) / alone, "error": error,
            })  # fmt: skip
    return rows


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
    parser.add_argument("--particles", type=int, default=100_000)
    parser.add_argument("--features", type=int, default=10)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=5.0, help="longest time of the repeats of one row")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commit", default="", help="for a copy of the tree that is no git repository")
    parser.add_argument("--output", type=Path, help="path without ending for the .json and .md files")
    arguments = parser.parse_args()
    present = [d.selection for d in gs.devices() if d.available and d.kind != "simulator"]
    rows = []
    for backend in arguments.backend or present:
        for count in arguments.landmarks or (20, 100, 10_000, 100_000):
            rows += rows_of(backend, count, arguments)
    command, host = command_line("bench/landmarks.py"), machine(arguments.commit)
    described = ", ".join(f"{name} {value}" for name, value in host.items())
    table = f"{to_markdown(rows)}\n\nMachine: {described}. Command: `{command}`.\n"
    print(table)
    if arguments.output:
        report = {"command": command, "machine": host, "rows": rows}
        write_report(arguments.output, report, table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
