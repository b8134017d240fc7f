"""Compare the likelihood field with beam models for ultrasound sensors, on simulated and recorded sonar rings.

    python bench/studies/sonar_field.py --output bench/results/sonar --figures docs/img
    python bench/studies/sonar_field.py --quick --places building

Simulated: a ring of 16 sensors in the built-in building, cones of 30 degrees, walls that are mirrors beyond 0.4 rad.
Recorded, where GPUSENSE_DATA names the data: the run ``sonar_pioneer8``, 8 sensors, in a map made of its even frames.
Every model is tuned on separate frames for the largest information, and scored on the other ones. The scored pose is
known; particles are spread around a guess or over the whole map:

- rank: the share of particles that score better than the true pose, 0 at best;
- information: the logarithm of the true pose's weight among N particles, times N, which is 0 without any reading;
- error: distance from the true position to the weighted mean of the particles around the guess.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.evaluation.worlds import building, cloud_around, cloud_uniform, free_pose, simulate_scan
from gpusense.plots import drawing as plots

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import make_parser, parse, publish, table

SPREAD_XY, SPREAD_THETA = 0.3, 0.2
FIELD, LASER, CONE, MIRRORS = "likelihood field", "beams without cone", "beams with cone", "cone and mirrors"
COLOURS = {FIELD: "#f3722c", LASER: "#9aa5b1", CONE: "#0077b6", MIRRORS: "#3a0ca3"}


@dataclass(frozen=True)
class Place:
    """A map, a ring of sensors, and frames (poses and readings) to tune on and to score."""

    name: str
    grid: gs.OccupancyGrid
    ring: gs.Scanner
    tuning: tuple[np.ndarray, np.ndarray]
    scored: tuple[np.ndarray, np.ndarray]


# ---- places


def simulated(frames: int, rng: np.random.Generator) -> Place:
    """Simulate paths of 8 frames through the building, 0.15 m and some turn apart."""
    grid = building(2, (24.0, 16.0), 0.05)
    bearings = np.arange(16) * math.pi / 8
    ring = gs.Scanner(bearings, 5.0, cone=math.radians(30), cone_rays=31, critical_incidence=0.4)
    noise = gs.BeamParameters(0.9, 0.04, 0.03, 0.03, sigma_hit=0.03, lambda_short=0.5)
    poses = []
    while len(poses) < 2 * frames:
        pose = free_pose(grid, rng, 0.4)
        path = [pose]
        while len(path) < 8:
            path.append(gs.compose_poses(path[-1], (0.15, 0.0, rng.normal(0, 0.15))))
        places = np.array(path)
        col, row = ((places[:, :2] - grid.origin[:2]) / grid.resolution).astype(int).T
        if grid.free[row, col].all():
            poses += path
    z = np.array([simulate_scan(grid, ring, pose, noise, rng) for pose in poses])
    half = len(poses) // 2
    both = np.array(poses)
    return Place("building", grid, ring, (both[:half], z[:half]), (both[half:], z[half:]))


def recorded(folder: Path, frames: int) -> Place:
    """Read the run of a Pioneer with 8 sonars; odd frames are for tuning and scoring in turn."""
    raw, pose = (np.loadtxt(folder / name) for name in ("measurement.txt", "poses.txt"))
    poses = np.column_stack([pose[:, 1:3] / 1000, np.radians(pose[:, 3] / 10)])
    z = np.where(raw[:, 1:] >= 5110, np.inf, raw[:, 1:] / 1000)
    ring = gs.Scanner(np.radians([-90, -37.5, -22.5, -7.5, 7.5, 22.5, 37.5, 90]), 5.11, 0.39)
    grid = sonar_map(ring, poses[::2], z[::2], width=math.radians(20))
    parts = [(poses[first::4][:frames], z[first::4][:frames]) for first in (1, 3)]
    return Place("sonar_pioneer8", grid, ring, *parts)


def sonar_map(ring: gs.Scanner, poses: np.ndarray, z: np.ndarray, *, width: float) -> gs.OccupancyGrid:
    """Map by log odds from cones: free before a reading, occupied at it, with less weight towards the cone's edges."""
    side, reach = 0.05, ring.range_max
    low, high = poses[:, :2].min(axis=0) - reach, poses[:, :2].max(axis=0) + reach
    shape = np.ceil((high - low) / side).astype(int)[::-1]
    odds, near = np.zeros(shape), int(reach / side) + 1
    for pose, ranges in zip(poses, z, strict=True):
        col, row = ((pose[:2] - low) / side).astype(int)
        rows, cols = slice(max(row - near, 0), row + near), slice(max(col - near, 0), col + near)
        y, x = np.mgrid[rows.start : min(rows.stop, shape[0]), cols.start : min(cols.stop, shape[1])]
        dx, dy = low[0] + (x + 0.5) * side - pose[0], low[1] + (y + 0.5) * side - pose[1]
        far, direction = np.hypot(dx, dy), np.arctan2(dy, dx) - pose[2]
        for bearing, reading in zip(ring.bearings, ranges, strict=True):
            if not np.isfinite(reading):
                continue
            off = np.abs((direction - bearing + math.pi) % (2 * math.pi) - math.pi) / (width / 2)
            weight = np.where(off < 1, 1 - off * off, 0)
            at = np.abs(far - reading) < 0.075
            odds[rows, cols] += weight * np.where(at, 0.9, np.where(far < reading, -0.3, 0))
    cells = np.where(odds > 0.7, 100, np.where(odds < -0.3, 0, -1))
    return gs.OccupancyGrid(cells.astype(np.int8), side, (*low.tolist(), 0.0))


# ---- models


def rings(place: Place, name: str) -> list[tuple[dict[str, float], gs.Scanner]]:
    """List the sensors that a method may be tuned to."""
    if name in (FIELD, LASER):
        return [({}, ring_of(place))]
    found = []
    for cone, critical in itertools.product((15, 30), (0.4, 0.8) if name == MIRRORS else (None,)):
        ring = ring_of(place, cone=math.radians(cone), cone_rays=9, critical_incidence=critical)
        found.append(({"cone": cone} | ({} if critical is None else {"critical": critical}), ring))
    return found


def ring_of(place: Place, **options: Any) -> gs.Scanner:
    """Return the place's sensors with other cones."""
    ring = place.ring
    return gs.Scanner(ring.bearings, ring.range_max, ring.range_min, ring.mount, **options)


def mixtures(name: str, quick: bool) -> list[tuple[dict[str, float], Any]]:
    """List the parameters that a method may be tuned to; a middling one is first."""
    if name == FIELD:
        pairs = [(0.1, 0.5)] if quick else itertools.product((0.1, 0.05, 0.2, 0.4), (0.5, 0.1, 0.3, 0.7, 0.9))
        return [
            (one := {"sigma_hit": sigma, "z_rand": rand}, gs.LikelihoodFieldParameters(z_hit=1 - rand, **one))
            for sigma, rand in pairs
        ]
    weights = ((0.2, 0.2),) if quick else ((0.2, 0.2), (0.4, 0.2), (0.1, 0.4), (0.4, 0.4))
    return [
        (
            dict(sigma_hit=sigma, z_max=z_max, z_rand=rand),
            gs.BeamParameters(0.95 - z_max - rand, 0.05, z_max, rand, sigma, 0.5),
        )
        for sigma, (z_max, rand) in itertools.product((0.1, 0.05, 0.2), weights)
    ]


def tuned(
    place: Place, name: str, clouds: np.ndarray, z: np.ndarray, quick: bool, backend: Any
) -> tuple[dict[str, float], Any]:
    """Find the parameters and the model with the largest mean information about the first poses of clouds.

    Cones are chosen with a middling mixture, and then the mixture.
    """
    kind = gs.LikelihoodFieldModel if name == FIELD else gs.BeamModel

    def best(models: list[tuple[dict[str, float], Any]]) -> tuple[dict[str, float], Any]:
        means = [np.mean([information(one) for one in model.log_likelihood(clouds, z)]) for _, model in models]
        return models[int(np.argmax(means))]

    choices = mixtures(name, quick)
    middling = choices[0][1]
    some = [(numbers, kind(place.grid, ring, middling, backend=backend)) for numbers, ring in rings(place, name)]
    cones, chosen = best(some) if len(some) > 1 else some[0]
    models = [(numbers, kind(place.grid, chosen.scanner, p, backend=backend)) for numbers, p in choices]
    numbers, model = best(models)
    return numbers | cones, model


# ---- scores


def information(log_p: np.ndarray) -> float:
    """Return the logarithm of the first particle's weight times their number."""
    p = log_p.astype(np.float64)
    if not np.isfinite(p).any():
        return 0.0
    top = p.max()
    # An impossible pose has a weight of exp(-50).
    return max(float(p[0] - top - np.log(np.exp(p - top).sum())), -50.0) + math.log(len(p))


def weighted_error(log_p: np.ndarray, cloud: np.ndarray, truth: np.ndarray) -> float:
    """Return the distance from the truth to the weighted mean of a cloud's positions."""
    p = log_p.astype(np.float64)
    weights = np.exp(p - p.max()) if np.isfinite(p).any() else np.ones(len(p))
    return float(np.hypot(*(weights @ cloud[:, :2] / weights.sum() - truth[:2])))


def scores(
    place: Place, model: Any, window: int, particles: int, every: int, rng: np.random.Generator
) -> dict[str, list[float]]:
    """Score windows of consecutive frames with known motion, around a guess and over the whole map."""
    poses, z = place.scored
    found: dict[str, list[float]] = {name: [] for name in ("rank", "information", "error", "global rank", "prior")}
    for last in range(window - 1, len(poses), every):
        frames = slice(last - window + 1, last + 1)
        truth, back = poses[last], gs.pose_difference(poses[last], poses[frames])
        guess = cloud_around(truth, 1, SPREAD_XY, SPREAD_THETA, rng)[0]
        near = np.vstack([truth, cloud_around(guess, particles, SPREAD_XY, SPREAD_THETA, rng)])
        far = np.vstack([truth, cloud_uniform(place.grid, particles, rng)])
        log_near, log_far = (
            model.log_likelihood(gs.compose_poses(cloud[None], back[:, None]), z[frames]).sum(axis=0)
            for cloud in (near, far)
        )
        found["rank"].append(better(log_near))
        found["information"].append(information(log_near))
        found["error"].append(weighted_error(log_near[1:], near[1:], truth))
        found["prior"].append(float(np.hypot(*(near[1:, :2].mean(axis=0) - truth[:2]))))
        found["global rank"].append(better(log_far))
    return found


def better(log_p: np.ndarray) -> float:
    """Return the share of particles that score better than the first one; equal scores count half."""
    return float((log_p[1:] > log_p[0]).mean() + 0.5 * (log_p[1:] == log_p[0]).mean())


def at_the_truth(model: Any, poses: np.ndarray, z: np.ndarray) -> dict[str, float | None]:
    """Compare readings with a beam model's expectation at the true poses.

    Return the median difference of readings with an expected return, and the share of readings without an echo where
    one is expected.
    """
    if not isinstance(model, gs.BeamModel):
        return {"bias": None, "unexpected_silence": None}
    expected, heard = model.expected_ranges(poses), np.isfinite(z)
    returns = expected < model.scanner.range_max
    return {
        "bias": float(np.median((z - expected)[heard & returns])),
        "unexpected_silence": float(returns[~heard].mean()) if not heard.all() else None,
    }


def measure(place: Place, arguments: argparse.Namespace, backend: Any) -> list[dict[str, Any]]:
    """Tune and score each method; return a row for each method and length of windows."""
    rng = np.random.default_rng(7)
    # Some 50 evenly chosen frames decide, each with at most 300 particles.
    step = max(len(place.tuning[0]) // 50, 1)
    poses, z = (each[::step] for each in place.tuning)
    clouds = []
    for pose in poses:
        guess = cloud_around(pose, 1, SPREAD_XY, SPREAD_THETA, rng)[0]
        count = min(arguments.particles, 300)
        clouds.append(np.vstack([pose, cloud_around(guess, count, SPREAD_XY, SPREAD_THETA, rng)]))
    rows = []
    for name in COLOURS:
        numbers, model = tuned(place, name, np.stack(clouds), z, arguments.quick, backend)
        numbers = {"numbers": numbers, **at_the_truth(model, *place.scored)}
        for window in (1, 8):
            # Simulated paths are of 8 frames.
            every = max((len(place.scored[0]) - window + 1) // arguments.scans, 1)
            every = window if window == 8 and place.name == "building" else every
            found = scores(place, model, window, arguments.particles, every, np.random.default_rng(11))
            rows.append({"place": place.name, "model": name, "window": window, **numbers, **found})
    return rows


# ---- report


def known(number: float | None) -> str:
    """Format a number, or a dash."""
    return "-" if number is None else f"{number:.2f}"


def to_markdown(rows: list[dict[str, Any]]) -> str:
    """Format a table of medians and means."""
    columns = (
        "place (scored)", "frames", "model", "tuned to", "rank median / mean", "global rank median / mean",
        "information mean [nats]", "error median / mean [m]", "of the guess [m]", "reading less expected, median [m]",
        "no echo where one is expected",
    )  # fmt: skip
    lines = []
    for row in rows:
        numbers = ", ".join(f"{name} {value:g}" for name, value in row["numbers"].items())
        pairs = [f"{np.median(row[k]):.3f} / {np.mean(row[k]):.3f}" for k in ("rank", "global rank", "error")]
        lines.append([
            f"{row['place']} ({len(row['rank'])})", row["window"], row["model"], numbers, *pairs[:2],
            f"{np.mean(row['information']):.2f}", pairs[2], f"{np.mean(row['prior']):.3f}", known(row["bias"]),
            known(row["unexpected_silence"]),
        ])  # fmt: skip
    return table(columns, lines)


def draw_scores(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw the shares of frames below each error and rank, for each place."""
    places = list(dict.fromkeys(row["place"] for row in rows))
    figure = plots.new_figure(9, 3.4 * len(places))
    for i, place in enumerate(places):
        for j, (key, title) in enumerate((("error", "error of the weighted mean [m]"), ("global rank", "global rank"))):
            ax = figure.add_subplot(len(places), 2, 2 * i + j + 1)
            for row in rows:
                if row["place"] == place:
                    values, style = np.sort(row[key]), "-" if row["window"] == 1 else "--"
                    label = row["model"] if row["window"] == 1 and i == j == 0 else None
                    share = np.arange(1, len(values) + 1) / len(values)
                    ax.step(values, share, style, color=COLOURS[row["model"]], where="post", label=label)
            ax.set(xlabel=title, ylim=(0, 1), ylabel="share of scored poses", title=place)
            if key == "global rank":
                ax.set_xscale("symlog", linthresh=1e-3)
                ax.set_xlim(left=0)
            ax.grid(alpha=0.3)
    figure.legend(loc="outside lower center", ncols=4, frameon=False, title="1 frame (lines), 8 frames (dashed)")
    plots.save(figure, path)


def draw_scene(place: Place, path: Path, backend: Any) -> None:
    """Draw one frame: the ends of its readings along the axes of the cones, and the rays that returned."""
    poses, _ = place.scored
    ring = place.ring
    model = gs.BeamModel(place.grid, ring, backend=backend)
    rays = gs.BeamModel(place.grid, gs.Scanner(ring.ray_bearings.ravel(), ring.range_max), backend=backend)
    expected = model.expected_ranges(poses)
    # The frame in which most sensors hear something off their axis, and some hear nothing.
    along = gs.BeamModel(place.grid, ring_of(place), backend=backend).expected_ranges(poses)
    aside = ((expected < ring.range_max) & (along - expected > 0.15)).sum(axis=1)
    silent = ((expected == ring.range_max) & (along < ring.range_max)).sum(axis=1)
    n = int(np.argmax(aside + 2 * np.minimum(silent, 3)))
    pose = poses[n]
    each = rays.expected_ranges(pose[None]).reshape(ring.count, ring.cone_rays)
    figure = plots.new_figure(6.5, 6.0)
    ax = figure.add_subplot()
    plots.draw_map(ax, place.grid)
    for k in range(ring.count):
        axis = pose[2] + ring.bearings[k]
        if expected[n, k] >= ring.range_max:
            end = pose[:2] + ring.range_max * np.array([math.cos(axis), math.sin(axis)])
            ax.plot(*zip(pose[:2], end, strict=True), ":", color="#9aa5b1", lw=1)
            continue
        angle = pose[2] + ring.ray_bearings[k, int(np.argmin(np.abs(each[k] - expected[n, k])))]
        hit = pose[:2] + expected[n, k] * np.array([math.cos(angle), math.sin(angle)])
        end = pose[:2] + expected[n, k] * np.array([math.cos(axis), math.sin(axis)])
        ax.plot(*zip(pose[:2], hit, strict=True), color=COLOURS[CONE], lw=1)
        arc = axis + np.linspace(-ring.cone / 2, ring.cone / 2, 20)
        ax.plot(pose[0] + expected[n, k] * np.cos(arc), pose[1] + expected[n, k] * np.sin(arc), color="#f3722c", lw=1)
        ax.plot(*end, "o", color="#d7263d", ms=5)
    ax.plot([], [], color=COLOURS[CONE], label="the ray that returns")
    ax.plot([], [], color="#f3722c", label="where in the cone it may come from")
    ax.plot([], [], "o", color="#d7263d", ms=5, label="where a likelihood field looks")
    ax.plot([], [], ":", color="#9aa5b1", label="no return: the wall is a mirror, or far")
    ax.set(xlim=(pose[0] - 4, pose[0] + 4), ylim=(pose[1] - 4, pose[1] + 4), xlabel="x [m]", ylabel="y [m]")
    ax.legend(loc="upper right", fontsize=8)
    plots.save(figure, path)


def draw_run(place: Place, path: Path) -> None:
    """Draw a map and the poses that are scored in it."""
    figure = plots.new_figure(6.5, 5.0)
    ax = figure.add_subplot()
    plots.draw_map(ax, place.grid)
    ax.plot(*place.scored[0][:, :2].T, ".", ms=2, color="#d7263d", label="scored poses")
    ax.set(xlabel="x [m]", ylabel="y [m]")
    ax.legend(loc="upper right", fontsize=8)
    plots.save(figure, path)


def main() -> int:
    """Measure, draw and write."""
    parser = make_parser(__doc__, backend="auto")
    parser.add_argument(
        "--data", dest="recorded", type=Path, default=os.environ.get("GPUSENSE_DATA"), help="default: GPUSENSE_DATA"
    )
    parser.add_argument("--places", default="building,sonar_pioneer8", help="names, separated by commas")
    parser.add_argument(
        "--scans", type=int, default=100, help="about the number of poses that are scored at each place"
    )
    parser.add_argument("--particles", type=int, default=1000)
    parser.add_argument("--quick", action="store_true", help="tune less")
    parser.add_argument("--figures", type=Path, help="folder for the drawings")
    arguments = parse(parser)
    begin, device, rows, left_out = time.perf_counter(), get_backend(arguments.backend), [], []
    if arguments.figures:
        arguments.figures.mkdir(parents=True, exist_ok=True)
    for name in arguments.places.split(","):
        if name == "building":
            place = simulated(4 * arguments.scans, np.random.default_rng(3))
            if arguments.figures:
                draw_scene(place, arguments.figures / "sonar-scene.png", device)
        elif name == "sonar_pioneer8" and arguments.recorded is not None:
            place = recorded(Path(arguments.recorded) / name, arguments.scans)
            if arguments.figures:
                draw_run(place, arguments.figures / "sonar-map.png")
        else:
            left_out.append(name)
            continue
        rows += measure(place, arguments, device)
    if not rows:
        parser.error(f"--places: none of {', '.join(left_out)} is there; recorded data need --data or GPUSENSE_DATA")
    if arguments.figures:
        draw_scores(rows, arguments.figures / "sonar-scores.png")
    report = {
        "device": device.info.name, "left_out": left_out, "particles": arguments.particles,
        "seconds": time.perf_counter() - begin, "rows": rows,
    }  # fmt: skip
    remark = f"{arguments.particles} particles, on {device.info.name}."
    publish(__file__, arguments, to_markdown(rows), report, remark)
    return 0


if __name__ == "__main__":
    sys.exit(main())
