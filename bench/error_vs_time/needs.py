"""Measure error against time of whole tasks: localisation, matching, learning, landmarks.

    python bench/error_vs_time/measure.py --backend opencl --no-models --output NAME
    python bench/error_vs_time/measure.py --backend opencl --no-models --need localisation --seconds 20 --output NAME

*Localisation*: a robot with a laser of 1080 beams over 270 degrees drives through a generated building. People hide a
fifth of the beams, and 2 % of the walls have moved since the map was made. Each setting of particles, beams, model,
temperature, stages and precision follows the robot from a start around its true pose. Errors are those of the position
over all seeds; times are those of a step: predict, correct, estimate. The first 70 scans do not count, since the
filter's first 60 all teach the temperature.

*Matching*: pairs of scans in the same building, at most 1.4 m and 30 degrees apart, with noise of 2 cm, from guesses
that are off by at most 0.5 m and 10 degrees. One call matches all pairs; its time is divided by their number. *In a
map*: scans on their map, from such guesses.

*Learning*: the parameters of the beam model from readings of known parameters; the error is the root mean square of the
six relative errors. *Landmarks*: the error is the KL divergence of the posterior of 10 000 particles from the posterior
of known correspondences in float64, at a comparable temperature.

Settings run in rounds, so that a busy machine slows all alike; drives with few particles and beams run in more rounds,
since their errors vary with the seed. A setting whose steps take longer than --longest runs once; one that would exceed
the time of its need is listed as left out.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense._util.documents import plain
from gpusense.backends import Backend
from gpusense.commands.output import machine
from gpusense.evaluation.benchmark.accuracy import factor_for, posterior_errors, temperature_of
from gpusense.evaluation.simulation.changes import surface_of

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

import rivals as other_programs
from common import note
from matching_tasks import between_scans, in_a_map, rivals
from recordings import BEAM
from speed.learning import TYPICAL, values
from speed.point_models import landmark_scene
from task_settings import NEEDS, Setting, Steps

SCHEMA = 1
# Scans of the drive, and scans at its beginning that do not count.
SCANS, SETTLING = 130, 70
SCANNER = gs.Scanner.uniform(angle_min=-2.356, angle_increment=4.712 / 1079, count=1080, range_max=30.0)
START = (0.5, 0.5, 0.26)
# Most particles x beams of a setting, by the kind of device.
MOST = {"cpu": 4_000_000, "gpu": 1_100_000_000}
# Number of runs of a drive, by the largest particles x beams: with few particles, the median error of a run has a
# relative standard deviation of a seventh. The number must not depend on the time that other runs took.
REPEATS = {100_000: 4, 1_000_000: 2}
# Methods that take about a hundred passes over the readings, and their most readings; runs of other methods.
SEARCHES, MOST_SEARCHED, FITS = ("hill_climb", "genetic"), 100_000, 4
PARTICLES = 10_000


# ---- localisation


def mapped(world: gs.OccupancyGrid) -> gs.OccupancyGrid:
    """Return the map that a laser makes of a world: surfaces are occupied, and cells behind them unknown."""
    cells = np.where(world.occupied & ~surface_of(world), -1, world.cells).astype(np.int8)
    return gs.OccupancyGrid(cells, world.resolution, world.origin, occupied_threshold=world.occupied_threshold)


def scan_model(kind: str, run: Any, beams: int, device: Backend, precision: str) -> tuple[Any, str]:
    """Return a model of the drive's laser, and its code."""
    made: dict[str, Any] = {"backend": device, "precision": precision, "beams": beams}
    words = f"beams={beams}" + (', precision="float64"' if precision == "float64" else "")
    if kind == "field":
        model = gs.LikelihoodFieldModel(run.grid, run.scanner, **made)
        return model, f"gs.LikelihoodFieldModel(grid, scanner, {words})"
    chosen: Any = gs.BeamParameters(**BEAM)
    if kind == "discrete":
        chosen = gs.DiscreteBeamModel(chosen, range_max=run.scanner.range_max, bins=600)
    elif kind != "beam":
        made["caster"] = kind.removeprefix("beam, ")
        words += f', caster="{made["caster"]}"'
    given = "gs.DiscreteBeamModel(gs.BeamParameters(), range_max=scanner.range_max), " if kind == "discrete" else ""
    return gs.BeamModel(run.grid, run.scanner, chosen, **made), f"gs.BeamModel(grid, scanner, {given}{words})"


def drive(run: Any, model: Any, seed: int, particles: int, options: dict[str, Any]) -> tuple[np.ndarray, Steps]:
    """Follow the robot; return the errors of the position [m] and the steps."""
    pf = gs.ParticleFilter(model, particles=particles, seed=seed, **options)
    pf.initialize(mean=run.poses[0], covariance=np.diag(np.square(START)))
    errors, steps = [], Steps(settling=SETTLING)
    for k, ranges in enumerate(run.scans):
        with steps:
            if k:
                pf.predict(run.odometry[k - 1], run.odometry[k])
            pf.correct(ranges)
            found = pf.estimate()
        errors.append(np.hypot(*(found.pose[:2] - run.poses[k, :2])))
    return np.array(errors[SETTLING:]), steps


def simulated(device: Backend) -> Any:
    """Return the drive that all filters follow."""
    building = gs.worlds.building(2, (50.0, 50.0))
    world = gs.worlds.change_world(building, np.random.default_rng(4), moved=0.02)
    return gs.worlds.simulate_run(
        mapped(building), SCANNER, world=world, scans=SCANS, hidden=0.2, seed=3, backend=device
    )


def localisation(device: Backend) -> Iterator[Setting]:
    """Yield the settings of localisation: particles and beams of each model, then variants of a middle one."""
    run = simulated(device)
    sizes = {
        "field": ((100, 300, 1000, 3000, 10_000, 100_000, 1_000_000), (8, 30, 60, 180, 1080)),
        "beam": ((100, 1000, 10_000, 100_000, 1_000_000), (8, 60, 180, 1080)),
        "discrete": ((1000, 10_000, 100_000), (60, 180)),
        "beam, march": ((1000, 10_000), (60,)), "beam, cddt": ((1000, 10_000), (60,)),
    }  # fmt: skip
    grid = [(kind, n, k, "float32", {}) for kind, (ns, ks) in sizes.items() for n, k in itertools.product(ns, ks)]
    # Settings for comparison with the filters of other programs.
    grid += [
        (kind, n, other_programs.BEAMS, "float32", {})
        for kind in ("field", "beam")
        for n in other_programs.PARTICLES[:2]
    ]
    varied: list[tuple[str, int, int, str, dict[str, Any]]] = [
        (kind, 1000, 60, precision, options)
        for kind in ("field", "beam")
        for precision, options in (
            ("float32", {"temperature": 1.0}), ("float32", {"stages": 1}),
            ("float32", {"temperature": 1.0, "stages": 1}), ("float64", {}),
        )
    ]  # fmt: skip
    for kind, n, k, precision, options in varied + sorted(grid, key=lambda one: one[1] * one[2]):
        if n * k > MOST[device.info.kind] or (precision == "float64" and not device.info.float64):
            continue
        model, code = scan_model(kind, run, k, device, precision)
        words = "".join(f", {name} {value:g}" for name, value in options.items())
        called = "".join(f", {name}={value!r}" for name, value in options.items())
        yield Setting(
            "localisation", kind, f"{n} x {k}{words}", f"gs.ParticleFilter({code}, particles={n}{called})", precision,
            lambda seed, n=n, model=model, options=options: drive(run, model, seed, n, options),
            repeats=next((times for most, times in REPEATS.items() if n * k <= most), 1),
        )  # fmt: skip


# ---- learning and landmarks


def learning(device: Backend) -> Iterator[Setting]:
    """Yield the settings of learning: methods and numbers of readings."""
    for count, method in itertools.product(
        (100, 1000, 10_000, 100_000, 1_000_000), ("em", "em-book", "gradient", "hill_climb", "genetic")
    ):
        if method in SEARCHES and count > MOST_SEARCHED:
            continue

        def run(seed: int, count: int = count, method: Any = method) -> tuple[np.ndarray, Steps]:
            (z, expected), steps = TYPICAL.draw(count, np.random.default_rng(seed)), Steps()
            with steps:
                fit = gs.fit_beam_parameters(z, expected, TYPICAL.range_max, method=method, backend=device)
            relative = values(fit.parameters) / values(TYPICAL.parameters) - 1
            return np.array([np.sqrt(np.mean(np.square(relative)))]), steps

        code = f'gs.fit_beam_parameters(ranges, expected, range_max, method="{method}")'
        precision = "float64" if device.info.float64 else "float32"
        repeats = 1 if method in SEARCHES or count > MOST_SEARCHED else FITS
        yield Setting("learning", method, f"{count} readings", code, precision, run, repeats=repeats)


def landmarks(device: Backend) -> Iterator[Setting]:
    """Yield the settings of landmarks: known and unknown correspondences, precisions."""
    scene = landmark_scene(100, PARTICLES, 0)
    features, known, poses = scene.features[:20, :2], scene.seen[:20], scene.clouds["tracking"]
    right = gs.LandmarkModel(scene.landmarks, backend="numpy", precision="float64").log_likelihood(
        poses, features, known
    )
    factor = temperature_of(right)
    size = gs.normalize_weights(factor * right).effective_sample_size
    kinds: dict[str, tuple[dict[str, Any], bool, int]] = {
        "known": ({}, True, 20), "nearest": ({}, False, 20), "sum": ({"association": "sum"}, False, 20),
        "negative information": ({"negative": True}, False, 20), "nearest, every other": ({}, False, 2),
    }  # fmt: skip
    for (kind, (options, given, used)), precision in itertools.product(kinds.items(), ("float32", "float64")):
        if precision == "float64" and not device.info.float64:
            continue
        chosen = slice(None, None, 2) if used == 2 else slice(None)
        model = gs.LandmarkModel(scene.landmarks, backend=device, precision=precision, **options)

        def run(seed: int, model: Any = model, chosen: slice = chosen, given: bool = given) -> tuple[np.ndarray, Steps]:
            steps = Steps()
            for _ in range(5):
                with steps:
                    log_p = model.log_likelihood(poses, features[chosen], known[chosen] if given else None)
            scores = np.asarray(log_p, np.float64)
            kl = posterior_errors(factor_for(scores, size) * scores, factor * right, poses)["kl"]
            return np.array([kl]), steps

        words = "".join(f", {name}={value!r}" for name, value in options.items()).replace("'", '"')
        count = len(features[chosen])
        yield Setting(
            "landmarks", kind, f"{PARTICLES} x {count}", f"gs.LandmarkModel(landmarks{words})", precision, run
        )


SETTINGS: dict[str, Callable[[Backend], Iterator[Setting]]] = dict(
    zip(NEEDS, (localisation, between_scans, in_a_map, learning, landmarks), strict=True)
)

RIVALS: dict[str, Callable[[Backend], Iterator[Setting]]] = {
    "localisation": lambda device: other_programs.rivals(simulated(device), START, SETTLING), "matching": rivals,
}  # fmt: skip

# ---- all


def measure(need: str, device: Backend, arguments: argparse.Namespace, *, peers: bool = False) -> list[dict[str, Any]]:
    """Run all settings of a need in rounds, with ``peers`` also other programs'; return their rows."""
    settings = [*(RIVALS[need](device) if peers and need in RIVALS else ()), *SETTINGS[need](device)]
    begin = time.perf_counter()
    for number in range(arguments.rounds * max((one.repeats for one in settings), default=0)):
        for one in settings:
            if one.reason or number >= arguments.rounds * one.repeats:
                continue
            spent = time.perf_counter() - begin
            if spent > arguments.seconds:
                one.reason = one.reason or ("" if one.runs else f"the {arguments.seconds:g} s of this need were over")
                continue
            try:
                one.once(number)
            except Exception as error:
                one.reason = " ".join(f"{type(error).__name__}: {error}".split())
                continue
            step = float(np.median(one.seconds[-1]))
            if step > arguments.longest:
                one.reason = f"a step takes {step:.2g} s, more than {arguments.longest:g} s: measured once"
        note(f"{device.info.selection}: {need}, round {number + 1}, {time.perf_counter() - begin:.0f} s")
    return [one.row(device) for one in settings]


def add_options(parser: argparse.ArgumentParser, seconds: float = 120.0) -> None:
    """Add the options of :func:`measure`."""
    parser.add_argument("--need", action="append", choices=NEEDS, help="repeatable; default: all")
    parser.add_argument("--seconds", type=float, default=seconds, help="longest time of a need on a device")
    parser.add_argument("--longest", type=float, default=0.5, help="longest step that is repeated [s]")
    parser.add_argument(
        "--rounds", type=int, default=3, help="runs of each setting, each with its own seed; more of small drives"
    )
    parser.add_argument("--no-peers", action="store_true", help="without other implementations")


def measured(need: str, devices: Sequence[Backend], arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the rows of a need on some devices; other programs are measured with the first one."""
    return [
        row
        for i, device in enumerate(devices)
        for row in measure(need, device, arguments, peers=i == 0 and not arguments.no_peers)
    ]


def document(rows: Sequence[dict[str, Any]], stated: str | None, command: str) -> dict[str, Any]:
    """Return the report of some rows."""
    return plain({
        "schema": SCHEMA, "kind": "needs", "date": time.strftime("%Y-%m-%d"), "commit": stated, "command": command,
        "machine": machine(), "drive": {"scans": SCANS, "settling": SETTLING}, "rows": list(rows),
    }, 6)  # fmt: skip
