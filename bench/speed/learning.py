"""Measure speed and quality of learning the beam model's parameters: rates, fifty scenes, ten starts.

    python bench/speed/learning.py --backend numpy --backend opencl --backend warp:cpu --output NAME
    python bench/speed/learning.py --backend opencl --pairs 100000 --count 1000 --starts 2     # a quick look

*Rates*: one EM iteration (M-step and the passes over the pairs that it tries) on --pairs pairs of a typical scene,
without the second derivatives and with them, the upload, and a whole fit from its own start, of a normal and of a
Student t to readings of it, as the best and the median of several runs; one pass, and what of it are the kernel, waited
for, and the copy of its rows, the rest being their sum on the host, and in brackets a pass without lanes where the
device has some; beside them the NumPy reference on the same pairs (a part of them where it is slow, said so), whose
sums each backend's must match: *error* is the largest difference of the fitted parameters, relative, in float64.

*Scenes*, on the last backend: fifty with known parameters, from mild to stiff. Parameters whose standard error is
below 30 % of them are identified. For these the tables show: how many lie within 3 standard errors of the truth; the
largest decrease of the log-likelihood in an iteration of exact EM and of the book's; and, in scenes with all parameters
identified, how many nats "gradient" and "hill_climb" end from EM's optimum from --starts starts.

Exit code 1 where exact EM falls by more than 1e-9 of the log-likelihood, fewer than 95 % are within 3 standard errors,
or an end differs by more than 1e-4 nats.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.backends import Backend, BackendInfo, get_backend
from gpusense.backends.proxy import Proxy
from gpusense.learning.beam.device_sums import DeviceSums, make_bounds, open_device
from gpusense.learning.beam.em import em_step
from gpusense.learning.beam.pairs import Pairs, Point, first_guess, make_pairs, random_start
from gpusense.learning.beam.problem import NO_PRIOR, Problem

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))

from common import add_repeats, best, make_parser, parse, publish, table
from support.fit_scenes import Scene, learning_scenes

TYPICAL = Scene("typical", gs.BeamParameters(0.7, 0.1, 0.1, 0.1, 0.15, 0.5), 30.0, (0.02, 0.98))
IDENTIFIED, FALLS, SHARE, NATS = 0.3, 1e-9, 0.95, 1e-4


class Timed(Proxy):
    """A proxy of a backend that measures kernels and copies back to the host.

    Attributes:
        info: Information on the device, without lanes if ``lanes`` is False.
        seconds: Seconds of kernels and of downloads since the last reset.
    """

    def __init__(self, backend: Backend, lanes: bool = True) -> None:
        super().__init__(backend)
        self._info = backend.info if lanes else dataclasses.replace(backend.info, lanes=1)
        self.seconds = {"kernel": 0.0, "download": 0.0}

    @property
    def info(self) -> BackendInfo:
        """See Backend."""
        return self._info

    def compile(self, kernel: str, flags: frozenset[str]) -> Any:
        """See Backend.compile; launches are waited for."""
        launch = self._backend.compile(kernel, flags)

        def timed(size: tuple[int, ...], *arguments: Any) -> None:
            self._backend.synchronize()
            begin = time.perf_counter()
            launch(size, *arguments)
            self._backend.synchronize()
            self.seconds["kernel"] += time.perf_counter() - begin

        return timed

    def download(self, buffer: Any, out: np.ndarray, *, wait: bool = True) -> np.ndarray:
        """See Backend.download."""
        begin = time.perf_counter()
        found = self._backend.download(buffer, out, wait=wait)
        self.seconds["download"] += time.perf_counter() - begin
        return found


def pass_parts(backend: Backend, real: np.dtype, pairs: Pairs, point: Point, repeats: int) -> dict[str, float]:
    """Return the seconds of the fastest pass over the pairs, without second derivatives, and of its parts.

    ``scalar_s`` is that of passes without lanes, in turns with the others, where the device asks for lanes.
    """
    ways = [Timed(backend)] + ([Timed(backend, lanes=False)] if backend.info.lanes > 1 else [])
    devices = [DeviceSums(timed, real, pairs) for timed in ways]
    found: list[list[dict[str, float]]] = [[] for _ in ways]
    # The first pass compiles.
    for number in range(max(repeats, 1) + 1):
        for timed, device, seen in zip(ways, devices, found, strict=True):
            timed.seconds = dict.fromkeys(timed.seconds, 0.0)
            begin = time.perf_counter()
            device.sums(point)
            whole = time.perf_counter() - begin
            if number:
                seen.append({"pass_s": whole} | {f"{name}_s": value for name, value in timed.seconds.items()})
    quickest = [min(seen, key=lambda one: one["pass_s"]) for seen in found]
    return quickest[0] | ({"scalar_s": quickest[1]["pass_s"]} if len(ways) > 1 else {})


def values(parameters: gs.BeamParameters) -> np.ndarray:
    """Return the six parameters as an array."""
    return np.array(list(parameters.to_dict().values()))


def rates(selection: str, precision: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Measure the seconds of one iteration and of a fit on one backend."""
    backend, real = open_device(selection, precision)
    count = min(arguments.pairs, arguments.numpy_pairs) if selection == "numpy" else arguments.pairs
    z, expected = TYPICAL.draw(count, np.random.default_rng(arguments.seed))
    pairs = make_pairs(z, expected, TYPICAL.range_max)
    bounds = make_bounds(pairs)

    def upload() -> DeviceSums:
        device = DeviceSums(backend, real, pairs)
        backend.synchronize()
        return device

    uploaded = best(upload, arguments.repeats, arguments.seconds)
    problem = Problem(upload(), pairs, bounds, NO_PRIOR, False)
    value = problem.value(first_guess(pairs, bounds))
    problem.value(value.point, second=True)
    plain = best(lambda: em_step(problem, value), arguments.repeats, arguments.seconds)
    second = best(lambda: em_step(problem, value, second=True), arguments.repeats, arguments.seconds)
    parts = pass_parts(backend, real, pairs, value.point, arguments.repeats)
    fits: list[gs.BeamFit] = []

    def fit() -> None:
        fits.append(gs.fit_beam_parameters(z, expected, TYPICAL.range_max, backend=backend, precision=precision))

    whole = best(fit, 3, arguments.seconds)
    heavy = np.random.default_rng(arguments.seed)
    tailed = TYPICAL.parameters.replace(hit="student", hit_dof=3.0)
    z_tailed = gs.worlds.sample_readings(expected, TYPICAL.range_max, tailed, heavy)

    def fit_student() -> None:
        gs.fit_beam_parameters(
            z_tailed, expected, TYPICAL.range_max, backend=backend, precision=precision, hit="student"
        )

    student = best(fit_student, 3, arguments.seconds)
    same, far = slice(arguments.numpy_pairs), TYPICAL.range_max
    found, exact = (
        values(gs.fit_beam_parameters(z[same], expected[same], far, backend=one, precision=kind).parameters)
        for one, kind in ((backend, precision), ("numpy", "float64"))
    )
    error = float(np.max(np.abs(found / exact - 1)))
    return {
        "backend": backend.info.selection, "device": backend.info.name, "precision": precision, "pairs": count,
        "hits": pairs.hits, "upload_s": uploaded[0], "iteration_s": plain[0], "iteration_median_s": plain[1],
        "second_s": second[0], **parts, "pairs_per_s": pairs.hits / plain[0], "fit_s": whole[0],
        "student_s": student[0], "iterations": fits[-1].iterations, "passes": fits[-1].passes, "error": error,
        "converged": fits[-1].converged,
    }  # fmt: skip


def fall(trace: np.ndarray) -> float:
    """Return the largest fall in an iteration over the log-likelihood's size."""
    return float(np.max(-np.diff(trace), initial=0.0) / abs(trace[-1]))


def scene_row(number: int, scene: Scene, arguments: argparse.Namespace) -> dict[str, Any]:
    """Fit one scene from all starts, and compare."""
    z, expected = scene.draw(arguments.count, np.random.default_rng(arguments.seed + number))
    pairs = make_pairs(z, expected, scene.range_max)
    bounds = make_bounds(pairs)
    # Users call the function, which uploads the readings for every fit.
    run = dict(backend=arguments.backend[-1], precision="float64")
    fit = gs.fit_beam_parameters(z, expected, scene.range_max, **run)
    book = gs.fit_beam_parameters(z, expected, scene.range_max, method="em-book", **run)
    error = np.array(list(fit.standard_errors.values()))
    off = (values(fit.parameters) - values(scene.parameters)) / error
    identified = np.isfinite(error) & (error < IDENTIFIED * values(fit.parameters))
    ends: dict[str, float] = {}
    passes = {"em": [fit.passes]}
    if identified.all():
        rng = np.random.default_rng(arguments.seed + number)
        guess = first_guess(pairs, bounds)
        starts = [random_start(guess, bounds, rng).parameters() for _ in range(arguments.starts)]
        for method in ("gradient", "hill_climb"):
            each = [
                gs.fit_beam_parameters(z, expected, scene.range_max, method=method, initial=s, **run) for s in starts
            ]
            passes[method] = [one.passes for one in each]
            ends[method] = max((abs(one.log_likelihood - fit.log_likelihood) for one in each), default=0.0)
    return {
        "scene": scene.name, "truth": scene.parameters.to_dict(), "found": fit.parameters.to_dict(),
        "identified": int(identified.sum()), "within": int((np.abs(off[identified]) <= 3).sum()),
        "worst": float(np.max(np.abs(off[identified]), initial=0.0)), "iterations": fit.iterations,
        "passes": passes, "converged": fit.converged, "fall": fall(fit.trace), "book_fall": fall(book.trace),
        "book_falls": int((np.diff(book.trace) < -1e-9 * abs(book.trace[-1])).sum()),
        "book_behind": fit.log_likelihood - book.log_likelihood, "ends": ends,
    }  # fmt: skip


def passes_text(scenes: list[dict[str, Any]]) -> str:
    """Format the 5 % and 95 % quantiles of the passes of a fit by each method."""
    found = {}
    for method in ("em", "gradient", "hill_climb"):
        counts = [count for scene in scenes for count in scene["passes"].get(method, [])]
        if counts:
            low, high = np.quantile(counts, (0.05, 0.95))
            found[method] = f"{method} {low:.0f} to {high:.0f}"
    return ", ".join(found.values())


def to_markdown(rows: list[dict[str, Any]], scenes: list[dict[str, Any]]) -> str:
    """Format both tables."""
    columns = (
        "backend", "precision", "pairs", "upload ms", "EM iteration ms", "with 2nd derivatives ms",
        "one pass (no lanes) ms", "kernel, copy, sum ms", "10^6 pairs/s", "x NumPy", "fit s",
        "Student fit s", "passes", "error",
    )  # fmt: skip
    lines = []
    numpy = {row["precision"]: row["pairs_per_s"] for row in rows if row["backend"] == "numpy"}
    for r in rows:
        base = numpy.get(r["precision"])
        ratio = f"{r['pairs_per_s'] / base:.1f}" if base else "-"
        scalar = f" ({1e3 * r['scalar_s']:.2f})" if "scalar_s" in r else ""
        left = r["pass_s"] - r["kernel_s"] - r["download_s"]
        lines.append([
            f"{r['backend']} ({r['device']})", r["precision"], r["pairs"], f"{1e3 * r['upload_s']:.1f}",
            f"{1e3 * r['iteration_s']:.2f}", f"{1e3 * r['second_s']:.2f}", f"{1e3 * r['pass_s']:.2f}{scalar}",
            f"{1e3 * r['kernel_s']:.2f}, {1e3 * r['download_s']:.2f}, {1e3 * left:.2f}",
            f"{r['pairs_per_s'] / 1e6:.1f}", ratio, f"{r['fit_s']:.3f}",
            f"{r['student_s']:.3f}", r["passes"], f"{r['error']:.1e}",
        ])  # fmt: skip
    scene_columns = (
        "scene", "identified", "within 3 s.e.", "worst, s.e.", "iterations", "EM's worst fall", "book: falls",
        "book: nats behind", "gradient, nats off", "hill climbing, nats off",
    )  # fmt: skip
    scene_lines = []
    for s in scenes:
        ends = [f"{s['ends'][m]:.0e}" if m in s["ends"] else "-" for m in ("gradient", "hill_climb")]
        scene_lines.append([
            s["scene"], s["identified"], s["within"], f"{s['worst']:.1f}", s["iterations"], f"{s['fall']:.0e}",
            s["book_falls"], f"{s['book_behind']:.3g}", *ends,
        ])  # fmt: skip
    return f"{table(columns, lines)}\n\n{table(scene_columns, scene_lines)}"


def main() -> int:
    """Measure and write."""
    parser = make_parser(__doc__)
    parser.add_argument("--precision", action="append", help="float64 and float32 where not given")
    parser.add_argument("--pairs", type=int, default=10_000_000)
    parser.add_argument("--numpy-pairs", type=int, default=1_000_000, help="pairs of the NumPy reference at most")
    parser.add_argument("--scenes", type=int, default=50)
    parser.add_argument("--count", type=int, default=4000, help="readings of each scene")
    parser.add_argument("--starts", type=int, default=10)
    add_repeats(parser, 10, 20.0)
    arguments = parse(parser)
    rows = []
    for selection in arguments.backend:
        for precision in arguments.precision or ("float64", "float32"):
            if precision == "float32" or get_backend(selection).info.float64:
                rows.append(rates(selection, precision, arguments))
    scenes = [scene_row(i, scene, arguments) for i, scene in enumerate(learning_scenes(50)[: arguments.scenes])]
    identified, within = (sum(scene[name] for scene in scenes) for name in ("identified", "within"))
    fell = max((scene["fall"] for scene in scenes), default=0.0)
    off = max((nats for scene in scenes for nats in scene["ends"].values()), default=0.0)
    text = (
        f"{to_markdown(rows, scenes)}\n\n{within} of {identified} identified parameters within 3 standard errors; "
        f"exact EM falls by at most {fell:.1e} of the log-likelihood; other ways end within {off:.1e} nats. "
        f"Passes over the pairs of 9 fits in 10: {passes_text(scenes)}."
    )
    report = {"rows": rows, "scenes": scenes, "identified": identified, "within": within, "fall": fell, "off": off}
    publish(__file__, arguments, text, report)
    return 1 if fell > FALLS or within < SHARE * identified or off > NATS else 0


if __name__ == "__main__":
    sys.exit(main())
