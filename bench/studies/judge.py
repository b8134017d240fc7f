"""Judge the trajectories of compiled nav2_amcl and Beluga on nine logs with known losses: found, missed, false.

NAV2, BELUGA and BELUGA_INCLUDE name the copies, see ``bench/speed/filters.py``. Each program follows a part of each log
with its node's sensor model from around the true pose: as recorded, and carried away after a half, while the odometry
stands still. A loss is a run of at least five scans that are off by more than 1 m or 0.5 rad by the reference. It is
found if a judged pose says "lost" within it, after ``LATE`` scans at most, or at its end if that is earlier. A false
stretch says "lost" without such a scan in it or in the ``LATE`` scans before it.

The poses have no covariance, so their radius comes from the scans. The second table has its integrity at an alert limit
of ``ALERT_LIMIT``, with the truth of the logs (``gs.integrity``); the limit of a share comes from a bootstrap of blocks
of scans, or from their number if that is larger.

    python bench/studies/judge.py --output judge_cpu
    python bench/studies/judge.py --times --output judge_times_cpu
"""

from __future__ import annotations

import contextlib
import io
import shutil
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import recordings
import verdict_runs as runs
from accuracy.compiled_peers import Follower, Weigher
from common import make_parser, note, parse, publish, table
from scipy.stats import beta
from speed.filters import PEERS, load

import gpusense as gs
from gpusense._util.progress import progress
from gpusense.commands import cli
from gpusense.evaluation.tracking import START
from gpusense.localization.defaults import DEFAULTS

LOGS = ("intel", "csail", "aces", "belgioioso", "fhw", "seattle", "fr079", "jarvis-nav350", "olin")
# Defaults of the programs: model; z_hit, z_short, z_max, z_rand, sigma_hit, lambda_short, max_distance. Their default
# noise of the odometry, 0.2, loses the robot where scans are metres apart.
MODELS = {
    "default": ("field", (0.5, 0.05, 0.05, 0.5, 0.2, 0.1, 2.0)),
    "product": ("field, prob", (0.7, 0.0, 0.0, 0.3, 0.07, 0.1, 2.0)),
}
ALPHA = DEFAULTS.alpha
CASES = ("as recorded", "carried away")
# Least scans of a loss; most scans until it is found, and until the verdict recovers after it; wrong poses [m, rad].
LEAST, LATE, FAR, FAR_TURN = 5, 20, 1.0, 0.5
# Errors of poses that are certainly right [m, rad].
NEAR, NEAR_TURN = 0.3, 0.15
# Largest safe error [m]; risks of the radius; scans of a block.
ALERT_LIMIT, RISKS, BLOCK = 0.5, (0.01, 0.05), 13
COLUMNS = (
    "program", "case", "runs", "scans", "losses", "found", "missed", "median delay [scans]", "false stretches",
    "right scans", "said lost [%]", "scans within 0.3 m", "said lost [%]",
    "not said tracking of wrong scans [%]", "place within 1 m",
)  # fmt: skip
INTEGRITY = (
    "program", "case", "risk [%]", "scans", "above the radius [%]", "upper 95 % limit [%]",
    "hazardously misleading [%]", "misleading [%]", "available while right [%]", "median radius [cm]",
    "scans to an alert: median, most; within 5",
)  # fmt: skip


def follow(weigher, chosen, scanner, events, particles, seed):
    """Return the (S, 3) poses of a program. It follows the laser, since its scanner has no mount."""
    mount = np.array([*scanner.mount[:2], 0.0])
    start = gs.compose_poses(events[0].truth, mount)
    follower, poses = Follower(weigher, particles, start, START, ALPHA, seed), []
    for event in events:
        laser = follower.step(gs.compose_poses(event.odometry, mount), np.asarray(event.ranges, np.float64)[chosen])
        poses.append(gs.compose_poses(laser, gs.invert_poses(mount)))
    return np.array(poses)


def spans(flags):
    """Return the first and last index of each run of true flags."""
    edges = np.diff(np.concatenate([[0], np.asarray(flags, int), [0]]))
    return list(zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1, strict=True))


def rate(found, wrong):
    """Return the losses, their delays (None where missed), and the number of false stretches."""
    lost = np.array([word == "lost" for word in found.verdicts])
    losses = [(first, last) for first, last in spans(wrong) if last - first + 1 >= LEAST]
    delays, near = [], np.zeros(len(wrong), bool)
    for first, last in spans(wrong):
        near[first : last + 1 + LATE] = True
    for first, last in losses:
        said = np.flatnonzero(lost[first : min(last, first + LATE) + 1])
        delays.append(int(said[0]) if len(said) else None)
    false = sum(not near[first : last + 1].any() for first, last in spans(lost))
    return losses, delays, false


def one_run(recording, models, weigher, chosen, case, args, rng):
    """Return the figures of a run; None where the log has no such part."""
    known = [event for event in recording.events if np.isfinite(event.truth).all()]
    events = runs.window(known, args.scans, rng, kidnapped=case == CASES[1])
    if events is None:
        return None
    scanner = recording.places[0][1]
    poses = follow(weigher, chosen, scanner, events, args.particles, int(rng.integers(1 << 31)))
    scans = [
        gs.Scan(float(k), np.asarray(e.ranges, np.float64), scanner, tuple(e.odometry), None)
        for k, e in enumerate(events)
    ]
    found = gs.judge_trajectory(models, scans, poses, searches=3)
    off = np.array([recordings.errors(pose, event.truth) for pose, event in zip(poses, events, strict=True)])
    wrong = (off[:, 0] > FAR) | (off[:, 1] > FAR_TURN)
    losses, delays, false = rate(found, wrong)
    near = (off[:, 0] < NEAR) & (off[:, 1] < NEAR_TURN)
    lost, sure = (np.array([one == word for one in found.verdicts]) for word in ("lost", "tracking"))
    known = off[:, 0], ~wrong
    rated = {risk: integrity_of(models, scans, poses, risk, *known) for risk in RISKS}
    places = []
    for stretch in found.stretches:
        if stretch.place is not None and stretch.place.found and wrong[stretch.first : stretch.last + 1].any():
            row = int(np.argmin(np.hypot(*(poses[:, :2] - stretch.pose[:2]).T)))
            places.append(bool(np.hypot(*(stretch.place.pose - events[row].truth)[:2]) < FAR))
    return dict(
        log=recording.name, case=case, scans=len(events), losses=len(losses), delays=delays, false=false,
        right=int((~wrong).sum()), right_lost=int((lost & ~wrong).sum()),
        near=int(near.sum()), near_lost=int((lost & near).sum()),
        wrong=int(wrong.sum()),
        wrong_doubted=int((~sure & wrong).sum()), places=places, integrity=rated,
    )  # fmt: skip


def integrity_of(models, scans, poses, risk, errors, right):
    """Return the figures of the radii of a trajectory at a risk."""
    radii = gs.judge_trajectory(models, scans, poses, risk=risk, searches=0).radii
    rated, block = gs.integrity(errors, radii, alert_limit=ALERT_LIMIT), BLOCK
    over = errors > radii
    return dict(
        blocks=[float(over[k : k + block].mean()) for k in range(0, len(over), block)], over=int(over.sum()),
        hazardous=rated.hazardous * len(over), misleading=rated.misleading * len(over), right=int(right.sum()),
        available=int((radii[right] <= ALERT_LIMIT).sum()), radii=radii[right & np.isfinite(radii)].tolist(),
        alerts=rated.times_to_alert.tolist(),
    )  # fmt: skip


def upper_limit(blocks, rng):
    """Return the upper 95 % limit of the mean of blocks: of a bootstrap, and of as many independent scans.

    The second one counts a block as one scan, so that no excess in n blocks gives about 3 / n.
    """
    count, mean = len(blocks), float(blocks.mean())
    drawn = rng.choice(blocks, (2000, count)).mean(axis=1)
    alone = float(beta.ppf(0.95, mean * count + 1, count * (1 - mean))) if mean < 1 else 1.0
    return max(float(np.quantile(drawn, 0.95)), alone)


def integrity_row(name, case, risk, chosen):
    """Return a row of the table of integrity."""
    every, scans = [one["integrity"][risk] for one in chosen], sum(one["scans"] for one in chosen)
    share = {key: 100 * sum(one[key] for one in every) / scans for key in ("over", "hazardous", "misleading")}
    blocks, radii, alerts = (
        np.array([value for one in every for value in one[key]]) for key in ("blocks", "radii", "alerts")
    )
    limit = upper_limit(blocks, np.random.default_rng(0))
    available, right = (sum(one[key] for one in every) for key in ("available", "right"))
    late = f"{np.median(alerts):.0f}, {alerts.max():.0f}; {(alerts <= 5).sum()} of {len(alerts)}"
    return (
        name, case, f"{100 * risk:g}", scans, f"{share['over']:.2f}", f"{100 * limit:.2f}",
        f"{share['hazardous']:.2f}", f"{share['misleading']:.2f}", f"{100 * available / max(right, 1):.1f}",
        f"{100 * np.median(radii):.0f}" if len(radii) else "-", late if len(alerts) else "-",
    )  # fmt: skip


def row_of(name, case, chosen):
    """Return a row of the table."""
    delays = [delay for one in chosen for delay in one["delays"]]
    found = [delay for delay in delays if delay is not None]
    keys = ("scans", "false", "right", "right_lost", "near", "near_lost", "wrong", "wrong_doubted")
    total = {key: sum(one[key] for one in chosen) for key in keys}
    places = [place for one in chosen for place in one["places"]]
    return (
        name, case, len(chosen), total["scans"], len(delays), len(found), len(delays) - len(found),
        f"{np.median(found):g}" if found else "-", total["false"],
        total["right"], f"{100 * total['right_lost'] / max(total['right'], 1):.2f}",
        total["near"], f"{100 * total['near_lost'] / max(total['near'], 1):.2f}",
        f"{100 * total['wrong_doubted'] / total['wrong']:.1f}" if total["wrong"] else "-",
        f"{sum(places)} of {len(places)}",
    )  # fmt: skip


def study(args):
    """Run all programs on all logs."""
    results, rows, rated = [], [], []
    model, parameters = MODELS[args.model]
    for number, (name, (_, package, _)) in enumerate(PEERS.items()):
        compiled, version, missing = load(name)
        if compiled is None:
            note(f"left out: {package}: {missing}")
            continue
        with progress(len(LOGS)) as step:
            for place, log in enumerate(args.logs):
                step(f"{package} {log}")
                recording = runs.load(log)
                grid, scanner = recording.places[0]
                chosen = np.linspace(0, scanner.count - 1, args.beams).round().astype(int)
                thin = gs.Scanner(scanner.bearings[chosen] + scanner.mount[2], scanner.range_max, scanner.range_min)
                weigher = Weigher(compiled, grid, thin, parameters, model)
                models = recordings.field(args.backend)(grid, scanner)
                for case, repeat in [(case, k) for case in CASES for k in range(args.repeats)]:
                    rng = np.random.default_rng((number, place, CASES.index(case), repeat))
                    found = one_run(recording, models, weigher, chosen, case, args, rng)
                    if found is not None:
                        results.append(found | dict(program=version))
        mine = [one for one in results if one["program"] == version]
        for case in CASES:
            part = [one for one in mine if one["case"] == case]
            rows.append(row_of(version, case, part))
            rated += [integrity_row(version, case, risk, part) for risk in RISKS]
    per_log = [
        row_of("both", log, [one for one in results if one["log"] == log])
        for log in dict.fromkeys(one["log"] for one in results)
    ]
    text = "\n\n".join([
        "### Programs", table(COLUMNS, rows), "### Integrity", table(INTEGRITY, rated),
        "### Logs", table(("program", "log", *COLUMNS[2:]), per_log),
    ])  # fmt: skip
    publish(__file__, args, text, dict(results=results, settings=dict(scans=args.scans, particles=args.particles)),
            f"The programs' field model: {args.model}; odometry noise 0.02.")  # fmt: skip


def times(args):
    """Measure ``gpusense judge`` on two bags: times of a recording, of the process's clock, and of its processors."""
    data, rows = recordings.data(), []
    truth = np.loadtxt(data / "olin_mac_bag" / "derived_reference.csv", delimiter=",", skiprows=1)
    folder = Path(tempfile.mkdtemp())
    half = np.sin(truth[:, 3] / 2), np.cos(truth[:, 3] / 2)
    rows_of = np.column_stack([truth[:, :3], *np.zeros((3, len(truth))), *half])
    np.savetxt(folder / "right.tum", rows_of, fmt="%.6f")
    third = len(truth) // 3
    rows_of[third : 2 * third, 1:3] += 2.0
    np.savetxt(folder / "wrong.tum", rows_of, fmt="%.6f")
    jarvis, olin = data / "jarvis_lab", data / "olin_mac_bag"
    bag = ["--map", olin / "mac_1st_floor_9_23.yaml", "--log", olin / "macfirst_floor_take_2", "--range-max", "12"]
    cases = {
        "jarvis, ROS 1 bag, 1440 beams": ["--map", jarvis / "jarvis_nav350_from_complex_03cm.yaml", "--log",
                                          jarvis / "jarvis_complex_path_fast.bag", "--topic",
                                          "/driver_laser_navigation/laser_scan", "--poses", "/pose_ground_truth"],
        "olin, ROS 2 bag, 720 beams": [*bag, "--poses", folder / "right.tum"],
        "olin, a third of the poses 2.8 m off": [*bag, "--poses", folder / "wrong.tum"],
    }  # fmt: skip
    table_of = folder / "judged.csv"
    for name, arguments in cases.items():
        found = []
        for _ in range(args.repeats):
            out, begin, used = io.StringIO(), time.perf_counter(), time.process_time()
            with contextlib.redirect_stdout(out):
                cli.main(["judge", *map(str, arguments), "--backend", args.backend, "--csv", str(table_of)])
            found.append((time.perf_counter() - begin, time.process_time() - used))
        recorded = np.loadtxt(table_of, delimiter=",", skiprows=1, usecols=1)
        wall, used = np.min(found, axis=0)
        length = float(np.ptp(recorded))
        rows.append((name, len(recorded), f"{length:.1f}", f"{wall:.1f}", f"{used:.1f}", f"{length / wall:.1f}",
                     out.getvalue().splitlines()[0]))  # fmt: skip
    shutil.rmtree(folder)
    columns = ("recording", "scans", "length [s]", "judged in [s]", "processor time [s]", "times real time", "verdict")
    publish(__file__, args, table(columns, rows), dict(rows=rows), "The best of the repetitions, files included.")


def main() -> None:
    parser = make_parser(__doc__, backend="opencl", seed=False)
    parser.add_argument("--times", action="store_true", help="measure the time of the command instead")
    parser.add_argument("--logs", nargs="+", default=list(LOGS), choices=LOGS)
    parser.add_argument(
        "--model", default="default", choices=MODELS, help="the nodes' default, or a product of densities"
    )
    parser.add_argument("--particles", type=int, default=2000)
    parser.add_argument("--beams", type=int, default=60, help="beams that the programs use")
    parser.add_argument("--scans", type=int, default=120, help="scans of a run")
    parser.add_argument("--repeats", type=int, default=1, help="runs of each case, or of the command")
    args = parse(parser)
    (times if args.times else study)(args)


if __name__ == "__main__":
    main()
