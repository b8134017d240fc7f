"""Fit the beam model's parameters of real sensors, and compare them with other programs' defaults on held-out readings.

    python bench/studies/fit_real.py --data DATA --output bench/results/fit_real             # everything; some minutes
    python bench/studies/fit_real.py --data DATA --set lidar_wall --set sonar1 --discrete 0.1

Each set is fitted on one half and scored on the other:

- sonar1, sonar2 (sonar_enmt482): a wall at a known distance, two recordings; every other block of 100 readings is held
  out. Readings of sonar2 with the wall nearer than 0.3 m, where it is blind, are left out.
- sonar1-transfer, sonar2-transfer: fitted on the recording "calibration", scored on "training1", in which the second
  sonar has another offset and more noise.
- lidar_wall: an LDS-02 before a wall at a taped distance, seven set-ups; every other scan is held out.
- intel, freiburg-079, csail, aces (carmen_logs): SICK lasers in 5 cm maps of the even scans; expected ranges are
    computed for the odd ones at their SLAM-corrected poses. Alternate blocks of odd scans are held out.
- pioneer8, pioneer8-cone (sonar_pioneer8): eight sonars in a 5 cm map of the even frames' readings; expected ranges of
    the odd frames along the axis, or in a cone of 15 degrees. Every other odd frame is held out.
- nav350, s3000 (jarvis_lab): two lasers with poses from reflectors, in 3 cm maps of the same run, so that both halves
    look better than a new run would. Alternate blocks of scans are held out.

The log-likelihood of a reading is a density [log 1/m], so it depends on the sensor; its difference between parameters
does not. Standard errors of the held-out figures are computed from blocks of neighbouring scans (--block) or of 100
readings of a sonar. The defaults of nav2_amcl and Beluga, with weights divided by their sums, are used in the book's
normalised mixture. Where the fitted parameters make a held-out reading impossible, half a reading of each cause is
added to the fit ("softened"). --discrete adds the discrete model with dependent causes, learned in bins of that width
on the same half, and its gain over the fitted mixture in the same bins. --incidence adds, for the logs of SICK lasers,
parameters for a number of bins of angles of incidence, and their gain over the same parameters for all angles.
--student adds fits with Student's t in place of the normal, and their gain over the fits with a normal.
"""

from __future__ import annotations

import argparse
import csv
import gzip
import math
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.evaluation import held_out
from gpusense.evaluation import range_data as fitting
from gpusense.evaluation.range_data import RangeData
from gpusense.world.scanner import Reading

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import LOGS, make_parser, note, odd_scans, parse, publish, table

SONARS = {"sonar1": (8.0, 0.0), "sonar2": (5.0, 0.3)}
# In the scanner's name: range_max [m], the reading that means "no return" below range_min, x of the mount [m].
LASERS = {"nav350": (25.0, 0.0), "s3000": (51.2, None)}


def read_columns(path: Path) -> dict[str, np.ndarray]:
    """Read the columns of a compressed CSV file; numeric ones become numbers."""
    with gzip.open(path, "rt", newline="") as stream:
        rows = list(csv.DictReader(stream))
    columns = {}
    for name in rows[0]:
        values = np.array([row[name] for row in rows])
        try:
            columns[name] = values.astype(float)
        except ValueError:
            columns[name] = values
    return columns


def sonar(data: Path, name: str, arguments: argparse.Namespace) -> tuple[RangeData, RangeData]:
    """Read the two recordings of a sonar, as halves or in blocks."""
    name, transfer, _ = name.partition("-transfer")
    top, blind = SONARS[name]
    halves = []
    for file in ("calibration", "training1"):
        columns = read_columns(data / "sonar_enmt482" / f"{file}.csv.gz")
        seen = columns["range"] >= blind
        z, expected = columns[name][seen], columns["range"][seen]
        halves.append(RangeData(z, expected, None, np.arange(len(z)) // 100, top))
    if transfer:
        return halves[0], halves[1]
    first, second = halves
    block = np.concatenate([first.block, second.block + first.block[-1] + 1])
    z, expected = (np.concatenate(pair) for pair in ((first.ranges, second.ranges), (first.expected, second.expected)))
    return RangeData(z, expected, None, block, top).halves()


def wall(data: Path, name: str, arguments: argparse.Namespace) -> tuple[RangeData, RangeData]:
    """Read all set-ups before the wall; each scan is a block."""
    columns = read_columns(data / "lidar_wall" / "frontal_beams.csv.gz")
    expected = columns["true_distance_m"] / np.cos(columns["angle_rad"])
    _, bag = np.unique(columns["bag"], return_inverse=True)
    _, block = np.unique(np.stack([bag, columns["scan"]]), axis=1, return_inverse=True)
    return RangeData(columns["range_m"], expected, None, block.ravel().astype(np.int64), 100.0).halves()


def log(data: Path, name: str, arguments: argparse.Namespace) -> tuple[RangeData, RangeData]:
    """Read the odd scans of a log in the map of the even ones."""
    grid, scans = odd_scans(data, name, arguments.scans or None)
    return fitting.data_of_log(
        grid, scans, backend=arguments.backend, block=arguments.block, incidence=bool(arguments.incidence)
    ).halves()


def laser(data: Path, name: str, arguments: argparse.Namespace) -> tuple[RangeData, RangeData]:
    """Read a laser of the vehicle, at its reference poses."""
    top, nothing = LASERS[name]
    folder = data / "jarvis_lab"
    with np.load(folder / "jarvis_complex_path_fast.npz", allow_pickle=False) as run:
        values = {key.removeprefix(f"{name}_"): run[key] for key in run if key.startswith(name)}
    valid = values["gt_valid"]
    ranges = values["ranges"][valid][: arguments.scans or None].astype(np.float64)
    poses = values["gt_pose"][valid][: len(ranges)]
    if nothing is not None:
        ranges[ranges == nothing] = np.inf
    # float32 readings of range_max differ slightly from it.
    ranges[ranges >= np.float32(top)] = np.inf
    scanner = gs.Scanner.uniform(
        angle_min=float(values["angle_min"]), angle_increment=float(values["angle_inc"]), count=ranges.shape[1],
        range_max=top, mount=(float(values["offset_x"]), 0.0, 0.0),
    )  # fmt: skip
    grid = gs.read_map(folder / f"jarvis_{name}_from_complex_03cm.yaml")
    model = gs.BeamModel(grid, scanner, backend=arguments.backend)
    expected = np.minimum(np.asarray(model.expected_ranges(poses), np.float64), top)
    block = np.repeat(np.arange(len(poses)) // arguments.block, ranges.shape[1])
    return RangeData(ranges.ravel(), expected.ravel(), None, block, top).halves()


def ring(data: Path, name: str, arguments: argparse.Namespace) -> tuple[RangeData, RangeData]:
    """Read the odd frames of a Pioneer's eight sonars in the map of the even ones."""
    folder = data / "sonar_pioneer8"
    raw, pose = (np.loadtxt(folder / file) for file in ("measurement.txt", "poses.txt"))
    poses = np.column_stack([pose[:, 1:3] / 1000, np.radians(pose[:, 3] / 10)])
    z = np.where(raw[:, 1:] >= 5110, np.inf, raw[:, 1:] / 1000)
    cone = {"cone": np.radians(15), "cone_rays": 7} if name.endswith("cone") else {}
    scanner = gs.Scanner(np.radians([-90, -37.5, -22.5, -7.5, 7.5, 22.5, 37.5, 90]), 5.11, 0.39, **cone)
    grid = sonar_map(scanner, poses[::2], z[::2], width=math.radians(20))
    model = gs.BeamModel(grid, scanner, backend=arguments.backend)
    halves = []
    for first in (1, 3):
        frames = slice(first, None if not arguments.scans else first + 4 * arguments.scans, 4)
        ranges, expected = z[frames], np.asarray(model.expected_ranges(poses[frames]), np.float64)
        block = np.repeat(np.arange(len(ranges)), ranges.shape[1])
        clipped = np.minimum(expected, scanner.range_max).ravel()
        halves.append(RangeData(ranges.ravel(), clipped, None, block, scanner.range_max))
    return halves[0], halves[1]


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


Loader = Callable[[Path, str, argparse.Namespace], tuple[RangeData, RangeData]]
SETS: dict[str, Loader] = {
    **dict.fromkeys((*SONARS, *(f"{name}-transfer" for name in SONARS)), sonar), "lidar_wall": wall,
    **dict.fromkeys(LOGS, log), **dict.fromkeys(LASERS, laser),
    "pioneer8": ring, "pioneer8-cone": ring,
}  # fmt: skip
# Where sensor and reference are not mounted in the same place.
BIASED = {*SONARS, "lidar_wall"}


def measure(data: Path, name: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Fit one half and score the other one."""
    half, rest = SETS[name](data, name, arguments)
    begin = time.perf_counter()
    fit = gs.fit_beam_parameters(
        half.ranges, half.expected, half.range_max, range_min=half.range_min, backend=arguments.backend,
        range_bias=name.removesuffix("-transfer") in BIASED,
    )  # fmt: skip
    seconds = time.perf_counter() - begin
    rows = [
        {"name": row.name, "parameters": row.parameters.to_dict(), **{key: finite(getattr(row, key)) for key in
         ("per_beam", "error", "gain", "gain_error", "impossible")}}
        for row in held_out.compare_held_out(
            fit.parameters, rest, readings=fit.hits + fit.max_readings
        )
    ]  # fmt: skip
    report = {
        "set": name, "range_max": half.range_max, "range_bias_fitted": fit.bias_fitted, "fit": fit.to_dict(),
        "fit_s": seconds, "readings": len(half.ranges), "held_out_readings": len(rest.ranges),
        "held_out_blocks": len(np.unique(rest.block)), "held_out": rows,
    }  # fmt: skip
    if arguments.discrete:
        report["discrete"] = discrete(half, rest, fit.parameters, arguments.discrete)
    if arguments.incidence and half.incidence is not None:
        report["incidence"] = by_incidence(half, rest, fit.parameters, arguments.incidence, arguments.backend)
    if arguments.student:
        report["student"] = student(half, rest, fit, arguments.backend)
    return report


def student(half: RangeData, rest: RangeData, normal: gs.BeamFit, backend: str) -> dict[str, Any]:
    """Fit hits with Student's t to one half, and compare them with normal ones on the other half."""
    begin = time.perf_counter()
    fit = gs.fit_beam_parameters(
        half.ranges, half.expected, half.range_max, range_min=half.range_min, backend=backend,
        range_bias=normal.bias_fitted, hit="student",
    )  # fmt: skip
    seconds = time.perf_counter() - begin
    readings = fit.hits + fit.max_readings
    rest = rest.chosen(rest.kinds != gs.Reading.MISSING)
    log_p = [held_out.log_densities(held_out.softened(each.parameters, readings), rest) for each in (fit, normal)]
    _, block = np.unique(rest.block, return_inverse=True)
    mean, error = held_out.block_mean(log_p[0] - log_p[1], block)
    # Student's t has one more parameter.
    bic = 2 * (fit.log_likelihood - normal.log_likelihood) - np.log(readings)
    return {
        "fit": fit.to_dict(),
        "fit_s": seconds,
        "bic": finite(bic),
        "gain": finite(mean),
        "gain_error": finite(error),
    }


def by_incidence(
    half: RangeData, rest: RangeData, parameters: gs.BeamParameters, bins: int, backend: str
) -> dict[str, Any]:
    """Learn parameters by angle of incidence on one half, and compare them with common ones on the other half."""
    assert half.incidence is not None
    fit = gs.fit_incidence_parameters(
        half.ranges, half.expected, half.incidence, half.range_max, range_min=half.range_min, bins=bins, backend=backend
    )
    rest = rest.chosen(rest.kinds != gs.Reading.MISSING)
    gain = held_out.incidence_log_densities(fit, rest) - held_out.log_densities(parameters, rest)
    _, block = np.unique(rest.block, return_inverse=True)
    mean, error = held_out.block_mean(gain, block)
    return {"fit": fit.to_dict(), "gain": finite(mean), "gain_error": finite(error)}


def without_missing(data: RangeData) -> RangeData:
    """Return the readings that are not missing, with infinite ranges for "no return"."""
    kept = data.chosen(data.kinds != Reading.MISSING)
    return replace(kept, ranges=np.where(kept.kinds == Reading.MAX, np.inf, kept.ranges))


def discrete(half: RangeData, rest: RangeData, parameters: gs.BeamParameters, width: float) -> dict[str, Any]:
    """Learn the discrete model on one half, and compare it with the fitted mixture in the same bins on the other
    half."""
    bins = min(max(round(half.range_max / width), 1), 4096)

    def moved(data: RangeData) -> RangeData:
        nearer = np.maximum(data.ranges - parameters.range_bias, 0)
        ranges = np.where(data.ranges < data.range_max, nearer, data.ranges)
        return without_missing(RangeData(ranges, data.expected, None, data.block, data.range_max))

    own, other = moved(half), moved(rest)
    begin = time.perf_counter()
    learned = gs.DiscreteBeamModel.learn(own.ranges, own.expected, half.range_max, bins)
    seconds = time.perf_counter() - begin
    soft = held_out.softened(parameters.replace(range_bias=0.0), len(own.ranges))
    mixture = gs.DiscreteBeamModel(soft, half.range_max, bins)
    gain = learned.log_likelihood(other.ranges, other.expected) - mixture.log_likelihood(other.ranges, other.expected)
    _, block = np.unique(other.block, return_inverse=True)
    mean, error = held_out.block_mean(gain, block)
    assert learned.fit is not None
    return {
        "bins": bins, "causes": learned.causes.to_dict(), "converged": learned.fit.converged, "learn_s": seconds,
        "gain": finite(mean), "gain_error": finite(error),
        "standard_errors": {key: finite(value) for key, value in learned.fit.standard_errors.items()},
    }  # fmt: skip


def finite(value: float) -> float | None:
    """Return a finite number, or None."""
    return value if np.isfinite(value) else None


def pair(value: float | None, error: float | None, digits: int = 3) -> str:
    """Format a value and its standard error."""
    if value is None:
        return "-inf"
    return f"{value:.{digits}g}" if error is None else f"{value:.{digits}g} +- {error:.1g}"


def to_markdown(reports: list[dict[str, Any]]) -> str:
    """Format fitted parameters, the held-out comparison, and the rows of options."""
    names = list(gs.BeamParameters().to_dict())
    fitted, compared, discrete_lines, incidence_lines, student_lines = [], [], [], [], []
    for report in reports:
        fit = report["fit"]
        cells = [pair(fit["parameters"][name], fit["standard_errors"][name]) for name in names]
        bias = pair(fit["range_bias"], fit["range_bias_error"]) if report["range_bias_fitted"] else "-"
        fitted.append([report["set"], f"{report['range_max']:g}", report["readings"], *cells, bias])
        *own, amcl, beluga = report["held_out"]
        remark = f" (softened: {own[0]['impossible']} impossible)" if len(own) > 1 else ""
        compared.append([
            report["set"], f"{report['held_out_readings']} ({report['held_out_blocks']})",
            pair(own[-1]["per_beam"], own[-1]["error"]) + remark, pair(amcl["gain"], amcl["gain_error"]),
            pair(beluga["gain"], beluga["gain_error"]),
        ])  # fmt: skip
        if "discrete" in report:
            own = report["discrete"]
            cells = [pair(own["causes"][name], own["standard_errors"][name]) for name in own["causes"]]
            discrete_lines.append([report["set"], own["bins"], *cells, pair(own["gain"], own["gain_error"])])
        if "student" in report:
            own = report["student"]
            errors, values = own["fit"]["standard_errors"], own["fit"]["parameters"]
            cells = [pair(values[name], errors[name]) for name in ("hit_dof", "sigma_hit", "z_hit", "z_rand")]
            gain = pair(own["gain"], own["gain_error"])
            student_lines.append([report["set"], *cells, f"{own['bic']:.0f}", gain, f"{own['fit_s']:.0f}"])
        if "incidence" in report:
            own = report["incidence"]
            each = own["fit"]["parameters"]["parameters"]
            cells = [", ".join(f"{one[name]:.3g}" for one in each) for name in ("sigma_hit", "z_max")]
            gain = pair(own["gain"], own["gain_error"])
            incidence_lines.append([report["set"], *cells, own["fit"]["no_surface_count"], gain])
    tables = {
        "Fitted parameters": (("set", "range_max [m]", "readings", *names, "bias [m]"), fitted),
        "Held-out log-likelihood of a reading [nats]": (
            ("set", "held out (blocks)", "fitted", "gain over nav2_amcl's defaults", "gain over Beluga's defaults"),
            compared,
        ),
        "Dependent causes against the fitted mixture in the same steps, on the held-out readings": (
            ("set", "bins", *gs.DiscreteCauses().to_dict(), "gain over the mixture [nats]"), discrete_lines,
        ),
        "Parameters by angle of incidence against the same for all, on the held-out readings": (
            ("set", "sigma_hit of the bins [m]", "z_max of the bins", "readings without a surface", "gain [nats]"),
            incidence_lines,
        ),
        "Hits of Student's t against normal ones": (
            ("set", "hit_dof", "sigma_hit [m]", "z_hit", "z_rand", "fall of BIC", "gain of a held-out reading [nats]",
             "fit [s]"),
            student_lines,
        ),
    }  # fmt: skip
    return "\n\n".join(f"### {title}\n\n{table(*content)}" for title, content in tables.items() if content[1])


def main() -> int:
    """Fit, compare and write."""
    parser = make_parser(__doc__, backend="auto", data=True)
    parser.add_argument("--set", action="append", choices=tuple(SETS), help="default: all")
    parser.add_argument("--scans", type=int, default=0, help="most scans of a laser; 0: all")
    parser.add_argument("--block", type=int, default=10, help="neighbouring scans of a block")
    parser.add_argument("--discrete", type=float, help="also learn the discrete model, in steps of that width [m]")
    parser.add_argument(
        "--incidence", type=int, help="also fit that number of bins of angles of incidence, where known"
    )
    parser.add_argument("--student", action="store_true", help="also fit hits of Student's t")
    arguments = parse(parser)
    reports = []
    for name in arguments.set or SETS:
        note(name)
        reports.append(measure(arguments.data, name, arguments))
    device = reports[0]["fit"]["device"]
    publish(__file__, arguments, to_markdown(reports), {"device": device, "sets": reports}, f"Device: {device}.")
    return 0 if all(report["fit"]["converged"] for report in reports) else 1


if __name__ == "__main__":
    sys.exit(main())
