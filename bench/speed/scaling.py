"""Measure how time grows with particles, beams and the map, above the floor that the device sets.

    python bench/speed/scaling.py --backend opencl:0:0 --backend warp:cuda:0 --output bench/results/scaling_h200
    python bench/speed/scaling.py --backend opencl --seconds 0.2 --total 60             # a processor

Three curves of rays, beam model and likelihood field (nearest), float32, 30 m of range at 5 cm: N particles with 60
beams, K beams with 10 000 particles, and the side of the map with 360 beams and 100 000 particles (4096 on processors).
Maps are the built-in building; above 2000 cells it is repeated side by side, since a building is not drawn larger. The
cloud is uniform over the free cells, except for the first particles, which are near one pose: float64 NumPy computes
these on a part of the map, and the largest difference is a point's error (also of ranges: rays that graze an obstacle
differ).

A *call* has NumPy arrays in and out. *Launches* are the same kernels one after the other, with everything on the
device. Points that take too long (--seconds, --total) or too much memory are left out and listed with the reason.

The floor. probes.py measures the peak rates of the device: launches, round trip, additions/s (issue), look-ups/s,
bytes/s of copies, up and down. With E particle-beams, N particles and L launches

    launches >= max(L * launch, round trip, operations / issue, look-ups / nearest, bytes / copy)
    call     >= max(launches, bytes up / upload + bytes down / download)

    operations  field 17 E + 60 N;   rays (46 + 41 steps) E + 60 N;   beam model (46 + 41 steps + 42) E + 60 N
    look-ups    field E;             rays and beam model reads * E
    bytes       24 N in, 4 N out (rays 4 E); these alone go up and down

and *nearest* is the rate of look-ups in a table that the nearest cache holds. The upper edge of the band that is drawn
above the floor uses the rate of look-ups at random places of a table as large as the model's: a cloud whose neighbours
share no cache lines. A real cloud's end points do, so times may be below the upper edge; a time below the floor is
reported, since it means a bad probe.

Operations are counted in kernels/opencl, as the fewest instructions: a multiplication is not merged with an addition
(ranges have the same bits everywhere), sizes and signs are free, a rounded division is 8, exp 8, log 15.

    end_point.cl, rounded_cell and table_cell: 4 of the rotation (fused), 2 of rounding, 4 of the distance from the
        middle, 2 maxima, 2 of the index, 1 address, 1 load, 1 addition                                             17
    raycast.cl, a step: 4 of the two counts and 2 of the index, 1 load, 1 branch; 8 of the sides; 4 of the crossing
        distances, 2 to choose, 2 of the limit; 3 selections, 10 of crossed, 4 of the new counts                    41
    raycast.cl and ray.cl, a ray: 6 of the rotation, 4 of TINY, 16 of two divisions, 4 of a_x and a_y, 2 signs,
        8 of the plane, 3 of the origin, 3 of expected_range                                                        46
    mixture.cl, hit and uniform part alone: 1 difference, 2 and exp 8, 5 of hit_mass, 2 and a division 8, log 15, 1 42
    placement.cl, a particle: cosine and sine 40, cell and fraction 20                                              60

Steps and reads per ray are counted: gpusense.reference casts some rays of the cloud in the device's table.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.tables.rectangles import planes_of

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import Recorder, best, make_parser, note, one_by_one, parse, publish, table_line, waited
from speed.probes import Figures, probe, rate
from speed.scaling_report import KINDS, cells, draw, figures_markdown
from speed.scaling_scenes import CHECKED, RANGE_MAX, Scene, count_reads, make_scene

OPERATIONS = {"field": 17, "ray": 46, "step": 41, "mixture": 42, "particle": 60}


@dataclass(frozen=True)
class Floor:
    """Least seconds of a call and of its launches, the limiting rate, and the upper edge of the band."""

    call: float
    launches: float
    scattered: float
    cause: str


def floor_of(kind: str, n: int, k: int, launches: int, table: int, reads: tuple[float, float], f: Figures) -> Floor:
    """Compute the floor by the formulas at the top of the file."""
    work, (per_ray, steps) = n * k, reads
    operations = OPERATIONS["particle"] * n
    look_ups = work if kind == "field" else per_ray * work
    if kind == "field":
        operations += OPERATIONS["field"] * work
    else:
        mixture = OPERATIONS["mixture"] if kind == "beam model" else 0
        operations += int((OPERATIONS["ray"] + OPERATIONS["step"] * steps + mixture) * work)
    up, down = 24 * n, 4 * (work if kind == "rays" else n)
    terms = {
        "launches": max(launches * f.launch_s, f.round_trip_s), "operations": operations / f.issue,
        "look-ups": look_ups / f.together, "bytes": (up + down) / rate(f.copy, up + down),
    }  # fmt: skip
    least = max(terms.values())
    transfer = up / f.upload + down / f.download
    cause = "transfer" if transfer > least else max(terms, key=lambda name: terms[name])
    return Floor(max(least, transfer), least, max(least, look_ups / rate(f.scattered, table)), cause)


@dataclass
class Device:
    """Measures one device, and lists the points that were left out."""

    selection: str
    arguments: argparse.Namespace
    scenes: dict[int, Scene]
    truths: dict[tuple[Any, ...], np.ndarray]
    rows: list[dict[str, Any]] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.start = time.perf_counter()
        self.backend = Recorder(get_backend(self.selection))
        self.info = self.backend.info
        self.figures = probe(self.selection, self.arguments.quick)
        self.failed, self.until = False, 0.0
        self.reads: dict[int, tuple[float, float]] = {}
        self.cloud: tuple[tuple[int, int], np.ndarray] = ((0, 0), np.empty((0, 3)))
        # Work and seconds of the last point of each curve.
        self.last: dict[tuple[str, str], tuple[float, float]] = {}
        self.models: dict[str, tuple[Any, Any]] = {}
        note(f"{self.info.selection}: probes took {time.perf_counter() - self.start:.1f} s")
        self.start = time.perf_counter()

    def scene(self, side: int) -> Scene:
        """Return the scene of a map, shared by devices."""
        if side not in self.scenes:
            self.scenes[side] = make_scene(side)
        return self.scenes[side]

    def run(self) -> None:
        """Measure all curves."""
        a = self.arguments
        many = a.map_particles or (100_000 if self.info.kind == "gpu" else 4096)
        for place, (axis, values) in enumerate((("particles", a.particles), ("beams", a.beams), ("side", a.sides))):
            # A third of the time for each curve, and the time that earlier curves left.
            self.until = a.total * (place + 1) / 3
            for value in values:
                n = value if axis == "particles" else a.beam_particles if axis == "beams" else many
                k = value if axis == "beams" else a.particle_beams if axis == "particles" else a.map_beams
                side = value if axis == "side" else a.side
                for kind in KINDS:
                    why = self.refused(axis, kind, n, k, side)
                    if not why:
                        try:
                            self.point(axis, value, kind, n, k, side)
                            continue
                        except MemoryError as error:
                            why = f"out of memory: {error}"
                        except (RuntimeError, ValueError) as error:
                            self.failed, why = True, f"failed: {error}"
                    self.left_out.append(f"{kind}, {axis} {value} ({n} x {k}, {side} x {side} cells): {why}")
                    note(f"{self.info.selection}: left out: {self.left_out[-1]}")

    def refused(self, axis: str, kind: str, n: int, k: int, side: int) -> str:
        """Return the reason for leaving a point out; empty otherwise."""
        spent = time.perf_counter() - self.start
        if spent > self.until:
            return (
                f"{spent:.0f} s are used up, of {self.until:.0f} s of the device's {self.arguments.total:.0f} s so far"
            )
        table = 2 * planes_of(self.backend, side, side).entries(side, side) if kind != "field" else 4 * side**2
        device = 1.5 * table + 8 * side**2 + min(100 * n + 4 * n * k, 1 << 30)
        host = 4 * side**2 + 60 * n + (4 * n * k if kind == "rays" else 0)
        if self.info.kind == "cpu":
            host, device = host + device, 0
        if device > 0.7 * self.info.memory or host > 0.5 * host_memory():
            return f"needs some {host / 1e9:.2g} GB of the host and {device / 1e9:.2g} GB of the device"
        work, seconds = self.last.get((axis, kind), (1.0, 0.0))
        size = side**2 if axis == "side" else n * k
        # A first call, a measured one, and launches alone.
        if (foreseen := 3 * seconds * size / work) > self.arguments.longest:
            return f"would take some {foreseen:.2g} s, more than the {self.arguments.longest:g} s of a point"
        return ""

    def point(self, axis: str, value: int, kind: str, n: int, k: int, side: int) -> None:
        """Measure one point."""
        scene = self.scene(side)
        if side not in self.reads:
            self.reads[side] = count_reads(scene, self.backend)
        if self.cloud[0] != (side, n):
            self.cloud = ((side, n), scene.cloud(n, np.random.default_rng(2)))
        poses = self.cloud[1]
        scanner = gs.Scanner(np.linspace(-np.pi, np.pi, k, endpoint=False), RANGE_MAX)
        key = ("scan", side, k)
        if key not in self.truths:
            scan = gs.RayCaster(scene.near, RANGE_MAX, method="dda", backend="numpy").cast(
                scene.pose[None], scanner.bearings
            )
            self.truths[key] = np.minimum(scan[0], RANGE_MAX - 0.1)
        model = self.model(kind, side, scanner)
        if kind == "rays":
            out = np.empty((n, k), np.float32)

            def call(poses: np.ndarray) -> np.ndarray:
                return model.cast(poses, scanner.bearings, out=out)
        else:

            def call(poses: np.ndarray) -> np.ndarray:
                return model.log_likelihood(poses, self.truths[key])

        start = time.perf_counter()
        call(poses)
        first = time.perf_counter() - start
        launches = self.backend.launches_of(lambda: call(poses))
        start = time.perf_counter()
        result = call(poses)
        once = time.perf_counter() - start
        seconds = min(self.arguments.seconds, self.arguments.total)
        least, median = best(lambda: call(poses), self.arguments.repeats, seconds) if once < seconds else (once, once)

        alone, _ = best(waited(self.backend, one_by_one(launches)), self.arguments.repeats, seconds)
        # They hold the call's buffers.
        launches_of_call = len(launches)
        launches.clear()
        self.backend.launches.clear()
        error = self.error(kind, scene, scanner, poses, result, side)
        floor = floor_of(kind, n, k, launches_of_call, model.table_bytes, self.reads[side], self.figures)
        grown = side**2 if axis == "side" else n * k
        # The first calls of small maps are mostly compilation.
        self.last[axis, kind] = (grown, max(least, first if axis == "side" and side >= 1000 else 0.0))
        row = {
            "backend": self.info.selection, "device": self.info.name, "axis": axis, "value": value, "what": kind,
            "particles": n, "beams": k, "side": side, "first_s": first, "call_s": least, "median_s": median,
            "launches": launches_of_call, "launch_s": alone, "table_bytes": model.table_bytes, "error": error,
            "reads": self.reads[side][0], "steps": self.reads[side][1], "floor_call_s": floor.call,
            "floor_launch_s": floor.launches, "scattered_s": floor.scattered, "cause": floor.cause,
        }  # fmt: skip
        self.rows.append(row)
        note(table_line(cells(row)))

    def model(self, kind: str, side: int, scanner: gs.Scanner) -> Any:
        """Return a model of the device, kept while map and beams stay the same."""
        key = (side, 0 if kind == "rays" else scanner.count)
        if self.models.get(kind, (None, None))[0] != key:
            # Free the old model's memory before making a new one.
            self.models.pop(kind, None)
            grid = self.scene(side).grid
            if kind == "rays":
                made: Any = gs.RayCaster(grid, RANGE_MAX, backend=self.backend)
            else:
                model = gs.BeamModel if kind == "beam model" else gs.LikelihoodFieldModel
                made = model(grid, scanner, backend=self.backend)
            self.models[kind] = (key, made)
        return self.models[kind][1]

    def error(
        self, kind: str, scene: Scene, scanner: gs.Scanner, poses: np.ndarray, result: np.ndarray, side: int
    ) -> float:
        """Return the largest difference of the first particles from float64 NumPy."""
        some = poses[:CHECKED]
        key = (kind, side, scanner.count, len(some), poses[0].tobytes())
        if key not in self.truths:
            common = {"backend": "numpy", "precision": "float64"}
            z = self.truths["scan", side, scanner.count]
            if kind == "rays":
                truth = gs.RayCaster(scene.near, RANGE_MAX, method="dda", **common).cast(some, scanner.bearings)
            elif kind == "field":
                truth = gs.LikelihoodFieldModel(scene.near, scanner, **common).log_likelihood(some, z)
            else:
                truth = gs.BeamModel(scene.near, scanner, caster="dda", **common).log_likelihood(some, z)
            self.truths[key] = truth
        return float(np.abs(result[: len(some)] - self.truths[key]).max())


def host_memory() -> float:
    """Return the host's free memory [bytes], where the system reports it."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return 1024.0 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration, ValueError):
        return 8e9


def numbers(text: str) -> list[int]:
    """Parse integers separated by commas; 1e4 is an integer."""
    return [int(float(word)) for word in text.split(",") if word]


def main() -> int:
    """Measure and write."""
    parser = make_parser(__doc__)
    parser.add_argument("--particles", type=numbers, default=numbers("1e2,1e3,1e4,1e5,1e6,1e7"))
    parser.add_argument("--beams", type=numbers, default=numbers("1,3,10,30,100,300,1000,3000,10000"))
    parser.add_argument("--sides", type=numbers, default=numbers("100,300,1000,3000,10000,20000"))
    parser.add_argument("--particle-beams", type=int, default=60, help="beams while particles vary")
    parser.add_argument("--beam-particles", type=int, default=10_000, help="particles while beams vary")
    parser.add_argument("--map-particles", type=int, default=0, help="while the map varies; 0: 100 000 or 4096")
    parser.add_argument("--map-beams", type=int, default=360)
    parser.add_argument("--side", type=int, default=2000, help="of the map while particles or beams vary [cells]")
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--seconds", type=float, default=0.15, help="longest time of the repeats of one point")
    parser.add_argument("--longest", type=float, default=4.0, help="a point that would take longer is left out [s]")
    parser.add_argument(
        "--total", type=float, default=36.0, help="time of one device after its probes [s]; what is left is listed"
    )
    parser.add_argument("--quick", action="store_true", help="probes of small arrays, to try the script")
    arguments = parse(parser)
    scenes: dict[int, Scene] = {}
    truths: dict[tuple[Any, ...], np.ndarray] = {}
    devices, failed = [], False
    for selection in arguments.backend:
        device = Device(selection, arguments, scenes, truths)
        device.run()
        failed |= device.failed
        devices.append({
            "backend": device.info.selection, "device": device.info.name, "driver": device.info.driver,
            "figures": dataclasses.asdict(device.figures), "rows": device.rows, "left_out": device.left_out,
            "seconds": time.perf_counter() - device.start,
        })  # fmt: skip
    report = {"operations": OPERATIONS, "devices": devices}
    publish(__file__, arguments, "\n".join(map(figures_markdown, devices)).rstrip("\n"), report)
    for device in devices if arguments.output else ():
        name = f"{arguments.output.name}_{device['backend'].replace(':', '_')}.png"
        draw(device, arguments.output.with_name(name))
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
