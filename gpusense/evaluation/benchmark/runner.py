"""Run every candidate in every cloud of every scene on every device, and record failures."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gpusense._util.typing import PRECISIONS
from gpusense.backends import Backend
from gpusense.evaluation.benchmark.accuracy import Truth, UnstableError, errors, fine_errors, truth_device
from gpusense.evaluation.benchmark.candidates import Candidate, Runner
from gpusense.evaluation.benchmark.scenes import CLOUDS, MapSource, Scene, make_scene

FINE_CLOUD = "tracking"
"""The cloud with which the errors on a fine grid of poses around the true pose are reported."""

LONG = 1.0
"""Duration of a call above which it is not repeated [s]."""
FEWEST = 3
"""Least number of timed calls."""

# Default number of particles of a call: enough to fill the device.
PARTICLES = {"gpu": 4096, "cpu": 1024}
# Divisor of that number for the slower NumPy reference.
NUMPY_SHARE = 8


class LeftOutError(ValueError):
    """Raised by a candidate that cannot be measured in a scene, for example because its table would take too long."""


@dataclass(frozen=True)
class Plan:
    """Plan of a run.

    Attributes:
        particles: N of a timed call; None for the device's default.
        checked: Largest number of particles whose results are checked.
        seconds: Longest time of a point's timed calls, of which there are at least three [s].
        build_limit: Longest time to build a table [s]; a point above it is left out.
        deadline: Measuring time, without compiling, after which no further point begins [s].
    """

    sources: Sequence[MapSource]
    backends: Sequence[Backend]
    candidates: Sequence[Candidate]
    precisions: Sequence[str] = PRECISIONS
    particles: int | None = None
    checked: int = 512
    beams: int = 360
    repeats: int = 20
    seed: int = 0
    seconds: float = float("inf")
    build_limit: float = 60.0
    deadline: float = float("inf")

    def particles_on(self, backend: Backend | None) -> int:
        """Return N of a timed call on a device; None means an outside candidate."""
        kind = "cpu" if backend is None else backend.info.kind
        count = PARTICLES[kind] if self.particles is None else self.particles
        numpy = backend is not None and backend.info.backend == "numpy"
        return max(count // NUMPY_SHARE, 1) if numpy else count

    @property
    def cloud(self) -> int:
        """Return the particles of a cloud: enough for every device and for the check."""
        return max([self.checked, *(self.particles_on(backend) for backend in (None, *self.backends))])


@dataclass(frozen=True)
class Job:
    """A candidate on a device."""

    candidate: Candidate
    backend: Backend | None
    precision: str

    @property
    def place(self) -> tuple[str, str]:
        """Return the device's selection string, or ``"outside"``, and the precision."""
        return self.backend.info.selection if self.backend else "outside", self.precision


@dataclass
class Outcome:
    """Result of a run.

    Attributes:
        points: One point per scene, cloud and job; see :func:`point_of`.
    """

    scenes: list[dict[str, Any]]
    points: list[dict[str, Any]]
    truth: dict[str, Any] = field(default_factory=dict)


def jobs(plan: Plan) -> list[Job]:
    """List the jobs of a cloud, devices innermost, so that a candidate runs on all devices under the same load."""
    listed = []
    for candidate in plan.candidates:
        if candidate.outside:
            listed.append(Job(candidate, None, candidate.precision))
            continue
        for precision in plan.precisions:
            able = (b for b in plan.backends if precision == "float32" or b.info.float64)
            listed += [Job(candidate, backend, precision) for backend in able]
    return listed


def steps(plan: Plan) -> int:
    """Count the points of a plan."""
    return len(plan.sources) * len(CLOUDS) * len(jobs(plan))


def run(plan: Plan, step: Callable[[str], None] = lambda text: None, outcome: Outcome | None = None) -> Outcome:
    """Measure all points of a plan."""
    device, spent = truth_device(), 0.0
    info = device.info
    note = "exact caster and models in float64; tests hold this device to the NumPy reference"
    outcome = Outcome([], []) if outcome is None else outcome
    outcome.truth = {"backend": info.selection, "device": info.name, "precision": "float64", "note": note}
    for source in plan.sources:
        scene = make_scene(source, device, beams=plan.beams, particles=plan.cloud, seed=plan.seed)
        truths = {cloud: Truth(scene, scene.clouds[cloud][: plan.checked], device) for cloud in CLOUDS}
        outcome.scenes.append(_description(scene))
        paces: dict[tuple[str, str], float] = {}
        for job in jobs(plan):
            made: Runner | None = None
            for cloud, truth in truths.items():
                step(f"{scene.name}, {cloud}, {job.candidate.label}")
                reason = _left_out(plan, job, scene, paces.get(job.place), spent)
                begin = time.perf_counter()
                point, made = point_of(plan, job, truth, cloud, reason, made)
                outcome.points.append(point)
                spent += time.perf_counter() - begin
                if point["time"]:
                    # Compiling does not count, so a first run measures about as many points as the next one.
                    spent -= point["time"]["first_s"]
                    if job.candidate.method == "exact" and job.candidate.problem == "ranges":
                        paces[job.place] = point["work"] / point["time"]["call_min_s"]
    return outcome


def point_of(
    plan: Plan, job: Job, truth: Truth, cloud: str, reason: str = "", made: Runner | None = None
) -> tuple[dict[str, Any], Runner | None]:
    """Measure one point; a failure becomes its status and reason.

    ``made``: The runner of another cloud, which serves this one if its table is of the whole map.

    Returns:
        Plain values. ``status`` is ``"ok"``, ``"failed"`` after an exception, ``"unstable"`` for results that are not
        finite, or ``"left out"`` for a point that was not tried. ``reason`` explains the status. And the runner, or
        None without a measurement.
    """
    scene, candidate, backend = truth.scene, job.candidate, job.backend
    particles = plan.particles_on(backend)
    beams = scene.scanner.count if candidate.problem == "ranges" else scene.hits
    point: dict[str, Any] = {
        "scene": scene.name, "cloud": cloud, "problem": candidate.problem,
        "backend": backend.info.selection if backend else "outside",
        "device": backend.info.name if backend else candidate.outside,
        "kind": backend.info.kind if backend else "cpu",
        "method": candidate.method, "variant": candidate.variant, "knob": candidate.knob, "value": candidate.value,
        "code": candidate.code, "precision": job.precision, "exact": candidate.exact,
        "outside": bool(candidate.outside), "particles": particles, "beams": beams, "work": particles * beams,
        "checked": len(truth.poses), "status": "left out" if reason else "ok", "reason": reason, "time": None,
        "errors": None,
    }  # fmt: skip
    if reason:
        return point, made
    made, first = made if candidate.whole else None, 0.0
    try:
        poses = scene.clouds[cloud][:particles]
        if made is None:
            begin = time.perf_counter()
            made = candidate.make(scene, backend, job.precision)
            made(poses)
            first = time.perf_counter() - begin
        runner = made
        point["time"] = {"first_s": first} | call_times(lambda: runner(poses), plan.repeats, plan.seconds)
        problem, factor = candidate.problem, candidate.temperature
        point["errors"] = errors(truth, problem, made(truth.poses), factor)
        if cloud == FINE_CLOUD and problem != "ranges":
            point["errors"]["fine"] = fine_errors(truth, problem, made(truth.fine(problem).poses), factor)
    except LeftOutError as error:
        point |= {"status": "left out", "reason": str(error)}
    except UnstableError as error:
        point |= {"status": "unstable", "reason": str(error)}
    except Exception as error:
        point |= {"status": "failed", "reason": " ".join(f"{type(error).__name__}: {error}".split())}
    return point, made


def _left_out(plan: Plan, job: Job, scene: Scene, pace: float | None, spent: float) -> str:
    """Return why a point is left out; empty if it is measured.

    ``pace``: Rays per second of the exact caster. ``spent``: Measuring time so far [s].
    """
    if job.candidate.missing:
        return job.candidate.missing
    if spent > plan.deadline:
        return f"the {plan.deadline:g} s of this run were over"
    rays = job.candidate.table_rays(scene) if job.candidate.table_rays else 0.0
    if pace and rays / pace > plan.build_limit:
        return f"building its table would take about {rays / pace:.0f} s, more than {plan.build_limit:g} s"
    return ""


def call_times(run: Callable[[], object], repeats: int, seconds: float = float("inf")) -> dict[str, float]:
    """Time calls after a warm-up, or the warm-up alone if it takes more than ``LONG``.

    ``seconds``: Time after which no further call begins, if there are at least ``FEWEST`` [s].

    Returns:
        Least time and quartiles of the elapsed times, the mean processor time over all threads [s], number of calls.
    """
    used: list[tuple[float, float]] = []
    while not used or (used[0][0] <= LONG and len(used) <= repeats):
        if len(used) > FEWEST and sum(elapsed for elapsed, _ in used[1:]) >= seconds:
            break
        begin, before = time.perf_counter(), time.process_time()
        run()
        used.append((time.perf_counter() - begin, time.process_time() - before))
    elapsed, processor = zip(*(used[1:] or used), strict=True)
    names, shares = ("call_min_s", "call_q1_s", "call_median_s", "call_q3_s"), (0.0, 0.25, 0.5, 0.75)
    quartiles = dict(zip(names, np.quantile(elapsed, shares).tolist(), strict=True))
    return quartiles | {"processor_s": statistics.fmean(processor), "calls": len(elapsed)}


def _description(scene: Scene) -> dict[str, Any]:
    rows, cols = scene.grid.shape
    return {
        "name": scene.name, "map": scene.origin, "rows": rows, "cols": cols, "resolution": scene.grid.resolution,
        "occupied": int(np.count_nonzero(scene.grid.occupied)), "free": int(np.count_nonzero(scene.grid.free)),
        "range_max": scene.scanner.range_max, "beams": scene.scanner.count, "hits": scene.hits,
        "pose": scene.pose.tolist(), "beam": scene.beam.to_dict(), "field": scene.field.to_dict(),
        "fingerprint": scene.fingerprint,
    }  # fmt: skip
