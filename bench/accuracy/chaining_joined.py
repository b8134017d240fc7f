"""Join the logs of two buildings, and count the closures between them: there must be none.

    python bench/accuracy/chaining_joined.py --backend opencl --output bench/results/chaining_joined

The scans of the second log follow those of the first one, without odometry, or with odometry that continues from the
end of the first log. Only the first scans of a log are used. Since all scans must be of one scanner, they are thinned
to the beams at whole degrees. Odometry is that of the corrected poses, which makes drifts small.

"within" counts the closures in each log, "across" those between the logs. "matches across" have a high p_right; "group"
is the size of the group of agreeing matches with the most evidence, and this evidence. Closures across a break of the
chain need 6.5, see ``gpusense.chaining.agreement``. Times are processor times.

The second table is of a chain of many short pieces of these logs, whose borders are all breaks. It counts the steps
whose match is used, and those of them that are not weak (``gpusense.chaining.front.Front.weak``).
"""

from __future__ import annotations

import itertools
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from chaining_logs import Log, from_scans
from common import make_parser, note, parse, publish, table

from gpusense.chaining.agreement import groups_of
from gpusense.chaining.chain import Chainer
from gpusense.chaining.matcher import SURE

NAMES = ("acapulco", "aces", "belgioioso", "csail", "fhw", "freiburg-079", "infinite-corridor", "intel", "seattle")
LIMIT = 50.0
# Length of a piece [m], and its smallest and largest number of scans.
PIECE, LEAST, MOST = 5.0, 9, 80
BEAMS = 180


def load(folder: Path, name: str, scans: int) -> Log:
    """Return the first scans of a log with its corrected poses as odometry, thinned to one-degree beams."""
    read = list(gs.read_log(folder / f"{name}-corrected.log.gz"))[:scans]
    degrees = np.round(np.degrees(read[0].scanner.bearings), 3)
    whole = np.flatnonzero(np.isclose(degrees, np.round(degrees)) & (degrees < 89.5))
    scanner = gs.Scanner(np.radians(np.round(degrees[whole])), LIMIT)
    thinned = [gs.Scan(s.time, s.ranges[whole], scanner, s.pose, s.pose) for s in read]
    poses = np.array([s.pose for s in read])
    return from_scans(name, thinned, poses, poses)


def joined(one: Log, two: Log, with_odometry: bool, backend: str) -> dict[str, Any]:
    """Chain two logs as one, and count closures."""
    border = len(one.ranges)
    moved = gs.pose_difference(np.repeat(two.odometry[:1], len(two.odometry), axis=0), two.odometry)
    odometry = np.concatenate([one.odometry, gs.compose_poses(one.odometry[-1], moved)])
    begun = time.process_time()
    ranges = np.concatenate([one.ranges, two.ranges])
    chainer = Chainer(ranges, one.scanner, odometry if with_odometry else None, backend=backend)
    for _ in chainer.steps():
        pass
    chain, loops = chainer.chain(), chainer.loops
    closures, matches = chain.closures, loops.matches.renumbered(loops.nodes)
    across, between = ((links.first < border) != (links.second < border) for links in (closures, matches))
    groups = groups_of(loops.matches[between], loops.solution.poses)
    most = int(np.argmax(groups.evidence)) if len(groups.evidence) else -1
    group, evidence = (int((groups.group == most).sum()), float(groups.evidence[most])) if most >= 0 else (0, 0.0)
    return {
        "first": one.name, "second": two.name, "odometry": with_odometry, "scans": len(odometry),
        "within": int((~across).sum()), "across": int(across.sum()), "matches": int(between.sum()),
        "group": group, "evidence": evidence, "said": bool(chain.doubtful[border]),
        "processor_s": time.process_time() - begun,
    }  # fmt: skip


def pieces(logs: list[Log], count: int) -> tuple[Log, np.ndarray]:
    """Return alternating pieces of logs of different buildings as one log, and the first scan of each piece."""
    rng, ranges, odometry, starts, last = np.random.default_rng(0), [], [np.zeros((1, 3))], [0], -1
    while len(ranges) < count:
        k = int(rng.integers(len(logs)))
        begin = int(rng.integers(len(logs[k].ranges) - LEAST))
        poses = logs[k].odometry[begin:]
        path = np.append(0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
        length = max(int(np.searchsorted(path, PIECE)), LEAST)
        if k == last or length > min(MOST, len(poses)):
            continue
        last, poses = k, poses[:length]
        ranges.append(logs[k].ranges[begin : begin + length])
        moved = gs.pose_difference(np.repeat(poses[:1], length, axis=0), poses)
        odometry.append(gs.compose_poses(odometry[-1][-1], moved))
        starts.append(starts[-1] + length)
    poses = np.concatenate(odometry[1:])
    return Log("pieces", np.concatenate(ranges), logs[0].scanner, poses, poses, None), np.array(starts[1:-1])


def steps_of(log: Log, starts: np.ndarray, with_odometry: bool, backend: str) -> list[Any]:
    """Count the steps over borders, and all others: those whose match is used, and those of them that are not weak."""
    chainer = Chainer(
        log.ranges, log.scanner, log.odometry if with_odometry else None, close_loops=False, backend=backend
    )
    for _ in chainer.steps():
        pass
    front = chainer.fronts[0]
    over = np.isin(np.arange(len(front.p_right)), np.searchsorted(front.nodes, starts) - 1)
    used, row = front.p_right >= SURE, ["with" if with_odometry else "no"]
    for some in (over, ~over):
        row += [int(some.sum()), int((some & used).sum()), int((some & used & ~front.weak).sum())]
    return row


def main(argv: list[str] | None = None) -> None:
    """Measure, and publish a table."""
    parser = make_parser(__doc__, backend="auto", data=True)
    parser.add_argument("--scans", type=int, default=250, help="scans of each log (default: %(default)s)")
    parser.add_argument("--log", action="append", choices=NAMES, help="default: all")
    parser.add_argument("--pieces", type=int, default=300, help="pieces of the second table (default: %(default)s)")
    arguments = parse(parser, argv)
    folder = Path(arguments.data) / "carmen_logs"
    logs = [load(folder, name, arguments.scans) for name in arguments.log or NAMES]
    rows = []
    for one, two in itertools.combinations(logs, 2):
        if one.scanner.count != two.scanner.count:
            note(f"{one.name} and {two.name} have other beams")
            continue
        for with_odometry in (True, False):
            rows.append(joined(one, two, with_odometry, arguments.backend))
            note(f"{one.name} and {two.name}: {rows[-1]['across']} of {rows[-1]['within']} closures across")
    lines = [
        [row["first"], row["second"], "with" if row["odometry"] else "no", row["scans"], row["within"], row["across"],
         row["matches"], f"{row['group']}, {row['evidence']:.1f}", "yes" if row["said"] else "no",
         f"{row['processor_s']:.1f}"]
        for row in rows
    ]  # fmt: skip
    columns = [
        "first", "second", "odometry", "scans", "closures within", "across", "matches across", "group, evidence",
        "border is doubtful", "s",
    ]  # fmt: skip
    total = f"{len(rows)} chains of {len(rows) // 2} pairs: {sum(row['across'] for row in rows)} closures across."
    parts = [log for log in (load(folder, name, sys.maxsize) for name in NAMES) if log.scanner.count == BEAMS]
    log, starts = pieces(parts, arguments.pieces)
    found = [steps_of(log, starts, with_odometry, arguments.backend) for with_odometry in (True, False)]
    heads = ["odometry", "borders", "used", "of these not weak", "further steps", "used", "of these not weak"]
    text = "\n\n".join([table(columns, lines), total, table(heads, found)])
    publish(__file__, arguments, text, {"rows": rows, "pieces": found})


if __name__ == "__main__":
    main()
