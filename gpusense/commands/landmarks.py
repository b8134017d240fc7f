"""``gpusense landmarks``: noise, suspicious landmarks, association and localisation of a recorded run."""

from __future__ import annotations

import argparse
import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gpusense._util.progress import progress
from gpusense.commands.common import (
    add_backend,
    add_json,
    add_seed,
    machine,
    machine_line,
    output_path,
    positive_number,
    print_json,
    print_table,
    whole_number,
)

if TYPE_CHECKING:
    from gpusense.evaluation.landmark_runs import Track
    from gpusense.learning.landmark.result import LandmarkFit
    from gpusense.learning.landmark.suspicious import Suspicions
    from gpusense.logs.records import LandmarkRun

NAME = "landmarks"
HELP = "Fit the noise of landmark readings in a recorded run, check the map, and localise the robot."

_EPILOG = """\
The folder holds files in the format of the UTIAS MRCLAM data, plain or with .gz after the name:
  Landmark_Groundtruth.dat  subject x y deviation deviation    Barcodes.dat           subject barcode
  RobotN_Odometry.dat       time v w                           RobotN_Measurement.dat time barcode range bearing
  RobotN_Groundtruth.dat    time x y heading
Parameters are fitted at the logged poses. A particle filter then starts around the first logged pose (0.5 m, 0.3 rad)
and sees odometry and readings only: with --known it is told the landmark of each, with --unknown it is not. The map
is used as it is: landmarks that are reported as exchanged stay so, and count as false positives.

Exit codes: 0 success, 2 bad input.

example:
  gpusense landmarks --folder MRCLAM_Dataset1 --robot 1
  gpusense landmarks --folder MRCLAM_Dataset1 --robot 2 --unknown --particles 5000 --plot run.png"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.epilog = _EPILOG
    add = parser.add_argument
    add("--folder", required=True, type=Path, metavar="DIR", help="the recorded run, in the format below")
    add("--robot", required=True, type=whole_number(low=1), metavar="N", help="which robot")
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--known", dest="known", action="store_true", default=True,
        help="the landmark of each reading is known by its barcode (default)")  # fmt: skip
    kind.add_argument("--unknown", dest="known", action="store_false", help="the filter is not told the landmarks")
    add("--particles", type=whole_number(low=2), default=2000, metavar="N", help="of the filter (default: %(default)s)")
    add("--scans", type=whole_number(low=1), metavar="S", help="at most so many scans")
    add("--range-max", type=positive_number, metavar="M",
        help="the sensor's largest range [m] (default: the next metre above the largest reading)")  # fmt: skip
    add("--field-of-view", type=positive_number, metavar="RAD",
        help="the angle in which it sees [rad] (default: a twentieth more than the readings')")  # fmt: skip
    add_backend(parser)
    add_seed(parser)
    add_json(parser)
    add("--plot", type=output_path(".png", ".pdf", ".svg"), metavar="FILE",
        help="draw path, estimate and landmarks")  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Fit, check, associate, localise, and print what came out."""
    from gpusense.evaluation import landmark_runs as lr
    from gpusense.logs.mrclam import read_mrclam
    from gpusense.models.landmark.model import LandmarkModel

    if args.field_of_view is not None and args.field_of_view > 2 * math.pi:
        raise ValueError(f"--field-of-view: must be in (0, 2 pi], got {args.field_of_view:g}")
    recorded = read_mrclam(args.folder, args.robot, range_max=args.range_max, field_of_view=args.field_of_view)
    own = lr.first_scans(recorded, args.scans)
    # What is suspicious needs the barcodes, whatever the filter is told.
    by_barcode = lr.fit_run(own)
    found = lr.suspicions(own, by_barcode)
    fit = by_barcode if args.known else lr.fit_run(own, known=False)
    model = LandmarkModel(own.landmarks, lr.usable(fit.parameters), backend=args.backend)
    agreement = lr.association(own, model, sigma_position=0.0, sigma_heading=0.0, seed=args.seed)
    with progress((len(own.time) + 99) // 100) as step:
        track = lr.localise(own, model, known=args.known, particles=args.particles, seed=args.seed, step=step)
    if args.json:
        print_json(_document(args, own, fit, found, agreement, track, model.device.selection))
    else:
        _print(args, own, fit, found, agreement, track)
    if args.plot is not None:
        draw(args.plot, own, track, found)
        if not args.json:
            print(f"drawn: {args.plot}")
    return 0


def _document(
    args: argparse.Namespace, own: LandmarkRun, fit: LandmarkFit, found: Suspicions, agreement: dict[str, float],
    track: Track, device: str,
) -> dict[str, Any]:  # fmt: skip
    options = {name: value for name, value in vars(args).items() if name not in ("run", "command", "json")}
    label = own.labels.tolist()
    return {
        "options": options,
        "scans": len(own.time),
        "features": len(own.ids),
        "left_out": own.left_out,
        "fit": fit.to_dict(),
        "exchanged": [
            asdict(each) | {"first": label[each.first], "second": label[each.second]} for each in found.exchanged
        ],
        "misplaced": [asdict(each) | {"landmark": label[each.landmark]} for each in found.misplaced],
        "association": agreement,
        "filter": track.summary(),
        "device": device,
        "machine": machine(),
    }


def _print(
    args: argparse.Namespace, own: LandmarkRun, fit: LandmarkFit, found: Suspicions, agreement: dict[str, float],
    track: Track,
) -> None:  # fmt: skip
    out = ", ".join(f"{count} of {what}" if what == "other robots" else f"{count} {what}" for what, count in
                    own.left_out.items())  # fmt: skip
    print(f"robot {args.robot}: {len(own.time)} scans with {len(own.ids)} readings of {len(own.landmarks)} landmarks")
    print(f"left out of the recording: {out}\n\n{fit}\n")
    for each in found.exchanged:
        a, b = own.labels[each.first], own.labels[each.second]
        print(
            f"SUSPICIOUS: landmarks {a} and {b} fit better exchanged: {each.before[0]:.0%} and {each.before[1]:.0%} of "
            f"their readings agree, {each.after[0]:.0%} and {each.after[1]:.0%} the other way round"
        )
    for one in found.misplaced:
        print(
            f"SUSPICIOUS: {one.agree:.0%} of the readings of landmark {own.labels[one.landmark]} agree with its place"
        )
    if not (found.exchanged or found.misplaced):
        print("no landmark is suspicious")
    kind = "known" if args.known else "unknown"
    s = track.summary()
    print(
        f"\nlikeliest landmark at the logged pose: {agreement['right']:.1%} right, {agreement['none']:.1%} taken for "
        f"false positives, {agreement['wrong']:.1%} wrong\n"
    )
    rows = [
        ("position [m]", f"{s['error_median']:.3f}", f"{s['error_90']:.3f}", f"{s['error_max']:.3f}"),
        ("heading [rad]", f"{s['heading_median']:.3f}", f"{s['heading_90']:.3f}",
         f"{float(track.error_heading.max()):.3f}"),
    ]  # fmt: skip
    print_table(("error", "median", "90 %", "largest"), rows, right=("median", "90 %", "largest"))
    print(f"\n{args.particles} particles, {kind} landmarks\n{machine_line()}")


def draw(path: Path, own: LandmarkRun, track: Track, found: Suspicions) -> None:
    """Draw logged path, estimate and landmarks, and the error over time."""
    from gpusense.plots.drawing import new_figure, save

    figure = new_figure(11.0, 6.0)
    axes = figure.subplot_mosaic([["map", "error"], ["map", "heading"]], width_ratios=(1.4, 1.0))
    ax = axes["map"]
    ax.plot(own.truth[:, 0], own.truth[:, 1], color="#8fa3b8", lw=1.0, label="logged path")
    ax.plot(track.estimate[:, 0], track.estimate[:, 1], color="#e4572e", lw=0.7, label="estimate")
    xy = own.landmarks.xy
    ax.plot(xy[:, 0], xy[:, 1], "k^", ms=5, label="landmarks")
    odd = sorted({i for e in found.exchanged for i in (e.first, e.second)} | {m.landmark for m in found.misplaced})
    if odd:
        ax.plot(xy[odd, 0], xy[odd, 1], "o", ms=13, mfc="none", mec="#b8860b", mew=1.8, label="suspicious")
    for label, (x, y) in zip(own.labels, xy, strict=True):
        ax.annotate(str(label), (x, y), xytext=(5, 4), textcoords="offset points", fontsize="small")
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    ax.legend(loc="best", fontsize="small")
    for name, values, unit in (("error", track.error, "position [m]"), ("heading", track.error_heading, "[rad]")):
        axes[name].plot(own.time, values, color="#e4572e", lw=0.6)
        axes[name].set(xlabel="time [s]", ylabel="error of the " + (unit if name == "error" else f"heading {unit}"))
    save(figure, path)
