"""Time one step of the particle filter: predict, score, normalise, resample and estimate.

A step that is one recorded program is also replayed many times in a row, which gives its time on the device.

The scene is a generated building, in which the particles track a robot. A filter with one stage is the plain filter.
The default filter has up to four stages, and on a processor a step runs only as many as its particles need. Three
filters take turns. The first has neither recovery nor verdict, the second has the verdict and ``estimate``, and the
third is the default, which can also recover.

``--histogram STEPS`` instead times ``predict``, ``correct`` and ``estimate`` of the default filter while a simulated
robot moves. It prints quantiles of the steps after the first 100, since the slowest step limits a control loop, and a
histogram of step times relative to the median. Then it prints the same quantiles by the extra work of steps, and the
number of copies from the device. This shows which work makes steps slow. Steps also have the processor time of the
calling thread: on a busy machine, only that one compares programs.

``--peers`` instead compares the default filter, with its estimate, to the filters of nav2_amcl and Beluga that
filters.py can compile. The filters take turns on one simulated run. All likelihood fields have the same parameters, and
the peers multiply the densities of a scan.
"""

from __future__ import annotations

import functools
import importlib
import itertools
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import json

import numpy as np
from accuracy.compiled_peers import Follower, Weigher
from common import command_line, commit, make_parser, middle_pose, table, table_line
from speed.filters import PEERS, load

import gpusense as gs
from gpusense.commands.output import machine, machine_line
from gpusense.evaluation.worlds import building

SIZES = ((2000, 60), (4000, 60), (100_000, 60))
# Scans in which a filter still learns the temperature; they are not timed.
SETTLING = 60


def measure(backend: str, particles: int, beams: int, stages: int, steps: int) -> dict[str, object]:
    """Return the median and least milliseconds of a step, without and with the verdict."""
    grid = building()
    scanner = gs.Scanner.uniform(angle_min=-np.pi / 2, angle_increment=np.pi / (beams - 1), count=beams, range_max=20.0)
    model = gs.LikelihoodFieldModel(grid, scanner, gs.LikelihoodFieldParameters(sigma_hit=0.1), backend=backend)
    pose = middle_pose(grid)
    ranges = gs.RayCaster(grid, range_max=20.0, backend=backend).cast(pose[None], scanner.bearings)[0]
    filters = []
    for recovery in (None, None, "sensor"):
        pf = gs.ParticleFilter(model, particles=particles, temperature=0.2, stages=stages, recovery=recovery)
        pf.initialize(mean=pose, covariance=np.diag([0.01, 0.01, 0.002]))
        filters.append(pf)
    verdict_of_first = filters[0]._parts.verdict
    verdict_of_first.is_informed_by, verdict_of_first.expected = lambda _: False, lambda *_: []
    times: list[list[float]] = [[], [], []]
    for _ in range(steps + 5):
        for which, (pf, kept) in enumerate(zip(filters, times, strict=True)):
            begin = time.perf_counter()
            pf.predict((0, 0, 0), (0, 0, 0))
            pf.correct(ranges)
            if which:
                pf.estimate()
            else:
                pf.mean_and_covariance()
            kept.append((time.perf_counter() - begin) * 1000)
    late, verdict, default = (kept[5:] for kept in times)
    # A mean without outliers of the machine, since only some steps compute the verdict.
    means = [float(np.minimum(kept, 4 * np.median(kept)).mean()) for kept in (late, verdict, default)]
    pf = filters[0]
    recorded = [kept.recording for key, kept in pf._cloud._recordings.items() if key[1].number == 0]
    return dict(
        backend=backend, particles=particles, beams=beams, stages=stages, median_ms=float(np.median(late)),
        least_ms=min(late), verdict_ms=means[1] - means[0], recovery_ms=means[2] - means[0],
        in_a_row_ms=_in_a_row(pf, steps, recorded[-1]) if recorded else None, start=pf.explain(),
    )  # fmt: skip


def _in_a_row(pf: gs.ParticleFilter, steps: int, recording: Any) -> float:
    """Return the device's milliseconds for a recording that is replayed again and again."""
    cloud, times = pf._cloud, []
    poses = cloud.host_poses(cloud.places.shown, cloud.count)
    for _ in range(5):
        # Each replay moves the same particles, which must not drift apart.
        for buffer in cloud.poses:
            cloud.backend.upload(poses, buffer)
        cloud.wait()
        begin = time.perf_counter()
        for _ in range(steps):
            recording()
        recording.wait()
        times.append((time.perf_counter() - begin) * 1000 / steps)
    return min(times)


# Edges of the histogram, as multiples of the median.
EDGES = (0.0, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0, 5.0, 10.0, np.inf)
WARM = 100
QUANTILES = (0.1, 0.5, 0.9, 0.99, 1.0)
# Methods with extra work, by a word for it; a commit has the methods of its time.
WORK = {
    "begin": ("sensors.Sensor", ("begin_lesson",)),
    "learn": ("lessons.Learner", ("_advanced",)),
    "search": ("rival.Recovery", ("_start",)),
    "rival": ("rival.Rival", ("correct",)),
    "stage": ("cloud.Cloud", ("_draw",)),
    "record": ("cloud.RecordedProgram", ("__init__",)),
    "judge": ("beam_consistency.MapJudge", ("consistency",)),
}


@functools.cache
def watch_work() -> list[str]:
    """Return a list that notes extra work when it is done, and each copy from the device as "copy"."""
    done: list[str] = []

    def watch(kind: Any, name: str, word: str) -> None:
        inner = getattr(kind, name)

        def noted(self: Any, *arguments: Any, **options: Any) -> Any:
            done.append(word)
            return inner(self, *arguments, **options)

        setattr(kind, name, noted)

    for word, (place, names) in WORK.items():
        module, kind = place.split(".")
        found = getattr(importlib.import_module(f"gpusense.localization.{module}"), kind)
        for name in names:
            if hasattr(found, name):
                watch(found, name, word)
    watch(importlib.import_module("gpusense.localization.cloud").Cloud, "_read", "copy")
    return done


def measure_steps(backend: str, particles: int, beams: int, steps: int) -> dict[str, object]:
    """Return quantiles [ms] and a histogram of the steps of the default filter, of the thread's time, and by work."""
    scanner = gs.Scanner.uniform(angle_min=-np.pi / 2, angle_increment=np.pi / (beams - 1), count=beams, range_max=20.0)
    grid = building()
    run = gs.worlds.simulate_run(grid, scanner, scans=WARM + steps, seed=1)
    field = gs.LikelihoodFieldParameters(sigma_hit=0.1)
    pf = gs.ParticleFilter(gs.LikelihoodFieldModel(grid, scanner, field, backend=backend), particles=particles, seed=1)
    pf.initialize(mean=run.poses[0], covariance=np.diag([0.01, 0.01, 0.0025]))
    times, kinds, done = [], [], watch_work()
    for before, odometry, ranges in zip(run.odometry, run.odometry[1:], run.scans[1:], strict=False):
        done.clear()
        begin, thread = time.perf_counter(), time.thread_time()
        pf.predict(before, odometry)
        pf.correct(ranges)
        pf.estimate()
        times.append((time.perf_counter() - begin, time.thread_time() - thread))
        copies = done.count("copy")
        words = sorted({word for word in done if word != "copy"})
        kinds.append(f"{' and '.join(words) or 'nothing'}, {copies} cop{'y' if copies == 1 else 'ies'}")
    elapsed, used = (1000 * np.array(times[WARM:])).T
    kind = np.array(kinds[WARM:])
    share = np.histogram(elapsed / np.median(elapsed), EDGES)[0] / len(elapsed)
    quantiles = [np.quantile(kept, QUANTILES).tolist() for kept in (elapsed, used)]
    error = float(np.hypot(*(pf.estimate().pose - run.poses[-1])[:2]))
    slow = elapsed >= np.quantile(elapsed, 0.9)
    by_work = [
        dict(work=str(one), steps=int(chosen.sum()), slowest_tenth=int((chosen & slow).sum()),
             wall_ms=np.quantile(elapsed[chosen], QUANTILES).tolist(),
             thread_ms=np.quantile(used[chosen], QUANTILES).tolist())
        for one in sorted(set(kind.tolist())) if (chosen := kind == one).any()
    ]  # fmt: skip
    return dict(
        backend=backend, particles=particles, beams=beams, steps=len(elapsed), wall_ms=quantiles[0],
        thread_ms=quantiles[1], histogram=share.tolist(), error_m=error, by_work=by_work,
    )  # fmt: skip


def print_steps(one: dict[str, Any]) -> None:
    """Print the histogram of a size, and its steps by their work, the most frequent first."""
    heads = ("work", "steps", "of the slowest tenth", "10, 50, 90, 99, 100 % ms", "of the thread")
    print(f"\n{one['particles']} x {one['beams']}:\n\n| {' | '.join(heads)} |\n|{' --- |' * len(heads)}")
    whole = dict(one, work="all", slowest_tenth="-")
    for row in (whole, *sorted(one["by_work"], key=lambda row: -row["steps"])):
        times = [", ".join(f"{t:.3f}" for t in row[name]) for name in ("wall_ms", "thread_ms")]
        print(f"| {row['work']} | {row['steps']} | {row['slowest_tenth']} | {times[0]} | {times[1]} |")
    bins = [f"{low:g}-{high:g}" for low, high in itertools.pairwise(EDGES)]
    shares = [f"{name}: {100 * share:.1f} %" for name, share in zip(bins, one["histogram"], strict=True)]
    print(f"\nMultiples of the median: {', '.join(shares)}", flush=True)


def measure_peers(backend: str, particles: int, beams: int, scans: int) -> list[dict[str, object]]:
    """Return the median and least milliseconds of a step of each filter: motion, weights, resampling, and a pose."""
    scanner = gs.Scanner.uniform(angle_min=-np.pi / 2, angle_increment=np.pi / (beams - 1), count=beams, range_max=20.0)
    grid = building()
    run = gs.worlds.simulate_run(grid, scanner, scans=SETTLING + scans, seed=1)
    field = gs.LikelihoodFieldParameters(sigma_hit=0.1)
    deviations, alpha = (0.1, 0.1, 0.05), (0.1,) * 4
    pf = gs.ParticleFilter(gs.LikelihoodFieldModel(grid, scanner, field, backend=backend), particles=particles, seed=1)
    pf.initialize(mean=run.poses[0], covariance=np.diag(deviations) ** 2)
    followers = {}
    for name, (_, package, _) in PEERS.items():
        compiled, version, missing = load(name)
        if compiled is None:
            print(f"left out: {package}: {missing}", flush=True)
            continue
        numbers = (field.z_hit, 0.0, 0.0, field.z_rand, field.sigma_hit, 0.1, field.max_distance)
        weigher = Weigher(compiled, grid, scanner, numbers, "field, prob")
        followers[f"{version}, product, 1 thread"] = Follower(weigher, particles, run.poses[0], deviations, alpha, 1)
    clocks: dict[str, list[tuple[float, float]]] = {name: [] for name in ("gpusense", *followers)}
    for before, odometry, ranges in zip(run.odometry, run.odometry[1:], run.scans[1:], strict=False):
        for name, kept in clocks.items():
            begin, processor = time.perf_counter(), time.process_time()
            if name == "gpusense":
                pf.predict(before, odometry)
                pf.correct(ranges)
                pf.estimate()
            else:
                followers[name].step(odometry, ranges)
            kept.append((time.perf_counter() - begin, time.process_time() - processor))
    rows = []
    for name, kept in clocks.items():
        elapsed, used = (1000 * np.array(kept[SETTLING:])).T
        rows.append(dict(
            filter=name, backend=backend if name == "gpusense" else "", particles=particles, beams=beams,
            median_ms=float(np.median(elapsed)), least_ms=float(elapsed.min()), processor_ms=float(np.median(used)),
        ))  # fmt: skip
    return rows


def _text(value: Any) -> str:
    return "-" if value is None else f"{value:.3f}"


def main() -> None:
    parser = make_parser(__doc__, backend="auto")
    parser.add_argument("--steps", type=int, default=100, help="steps of 2000 particles; larger clouds take fewer")
    parser.add_argument("--size", type=int, nargs=2, action="append", metavar=("PARTICLES", "BEAMS"), help="repeatable")
    parser.add_argument("--histogram", type=int, metavar="STEPS", help="measure single steps of the default filter")
    parser.add_argument("--peers", action="store_true", help="compare with nav2_amcl's and Beluga's filters")
    args = parser.parse_args()
    rows: list[dict[str, object]] = []
    if args.histogram:
        for particles, beams in args.size or SIZES:
            rows.append(measure_steps(args.backend, particles, beams, args.histogram))
            print_steps(rows[-1])
        return _write(args, rows)
    if args.peers:
        print(table(("filter", "particles x beams", "median ms", "least ms", "of all cores, median ms"), ()))
        for particles, beams in args.size or ((500, 60), (2000, 60)):
            for one in measure_peers(args.backend, particles, beams, args.steps):
                rows.append(one)
                figures = (f"{one[name]:.2f}" for name in ("median_ms", "least_ms", "processor_ms"))
                print(table_line((one["filter"], f"{particles} x {beams}", *figures)), flush=True)
        return _write(args, rows)
    print(table(("particles x beams", "stages", "median ms", "least ms", "verdict, more ms", "and recovery, more ms",
                 "recorded ones in a row ms", "start"), ()))  # fmt: skip
    for particles, beams in args.size or SIZES:
        for stages in (1, 4):
            one = measure(args.backend, particles, beams, stages, max(args.steps * 2000 // particles, 10))
            rows.append(one)
            figures = (f"{one[name]:.3f}" for name in ("median_ms", "least_ms", "verdict_ms", "recovery_ms"))
            last = (_text(one["in_a_row_ms"]), one["start"])
            print(table_line((f"{particles} x {beams}", stages, *figures, *last)), flush=True)
    _write(args, rows)


def _write(args: Any, rows: list[dict[str, object]]) -> None:
    print(f"\n{machine_line()}")
    if args.output is not None:
        stated = {"command": command_line("bench/speed/filter_step.py"), "commit": args.commit or commit()}
        report = stated | {"machine": machine(), "rows": rows}
        Path(args.output).with_suffix(".json").write_text(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
