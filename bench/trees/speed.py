"""Compare the rates of two trees (checkouts) in one run: the ratio of new to old time, row by row.

    python bench/compare_trees.py speed --old ../before                     # against this checkout
    python bench/compare_trees.py speed --old ../before --new . --backend warp:cuda:0 --blocks 5 --output NAME
    python bench/compare_trees.py speed --old . --new .                     # the noise of this machine

Rows are those of limits.py and small_calls.py that the public interface has: rays, beam model and field with a cloud
over the whole map and one around a pose, calls of 2000 and 4000 particles x 60 beams, ordinary and bound, several scans
in one call, steps of filters with 500 and 4000 particles (predict, correct, estimate), and the preparation of the map.
Arrays are NumPy's; on GPUs, rows with poses and results on the device time the launches alone.

Each tree runs in its own process (calls.py) on the same arrays. The processes take turns in the order old, new, new,
old, so that a machine that slows down favours neither. A turn takes --seconds; its shortest call counts.
Each pair of neighbouring turns gives a ratio. A block is a new pair of processes, since processes of the same tree also
differ.

The table shows the median times of the turns, the median and the quartiles of all ratios, the medians of the blocks,
and the ratio of the shortest turns. A row counts as slower if all of these but the upper quartile exceed --limit. The
exit code is 1 if a row is slower, or if --bits is set and bits of a result differ.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from common import ROOT, Scene, add_scene, make_parser, note, parse, publish, table, table_line

CHILD, SCRIPT = Path(__file__).with_name("calls.py"), Path(__file__).parents[1] / "compare_trees.py"
SMALL, FEW, SCANS, SCAN_PARTICLES = (2000, 4000), 60, 20, 500
MOST_CALLS = 200
COLUMNS = ("backend", "what", "old, ms", "new, ms", "new / old", "quartiles", "blocks", "shortest", "bits", "")


def write_arrays(path: Path, arguments: argparse.Namespace) -> str:
    """Write the map, clouds and scans for both trees, and return a description of the map."""
    scene = Scene(arguments)
    wide, few = scene.scanner(arguments.beams), scene.scanner(FEW)
    count = max(arguments.particles, 1000)
    scans = np.stack([scene.noisy_scan(few) for _ in range(SCANS)])
    np.savez(
        path, cells=scene.grid.cells, resolution=scene.grid.resolution, range_max=scene.range_max,
        bearings=wide.bearings, scan=scene.scan(wide), scans=scans,
        small=[min(size, count) for size in SMALL if size <= count or size == SMALL[0]],
        **{"few bearings": few.bearings, "few scan": scene.scan(few), "scan poses": np.stack([
            scene.cloud("tracking", min(SCAN_PARTICLES, count)) for _ in scans
        ])},
        **{name: scene.cloud(name, count) for name in ("global", "tracking")},
    )  # fmt: skip
    return scene.label


class Tree:
    """A process that times calls of one tree.

    Attributes:
        about: Its first answer: the package's file, backend, device and rows.
    """

    def __init__(self, tree: Path, arrays: Path, backend: str) -> None:
        search = os.pathsep.join(filter(None, (str(tree.resolve()), os.environ.get("PYTHONPATH"))))
        command = [sys.executable, "-P", str(CHILD), str(arrays), backend]
        environment = os.environ | {"PYTHONPATH": search}
        self._process = subprocess.Popen(
            command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.about = self._answer()
        if not Path(self.about["file"]).resolve().is_relative_to(tree.resolve()):
            raise RuntimeError(f"{tree}: must be a checkout of gpusense; {self.about['file']} is imported")

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"the process of a tree ended with exit code {self._process.wait()}")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def ask(self, row: str, calls: int) -> dict[str, Any]:
        """Run calls of a row; 0 prepares it."""
        assert self._process.stdin is not None
        print(json.dumps({"row": row, "calls": calls}), file=self._process.stdin, flush=True)
        return self._answer()

    def close(self) -> None:
        """End the process."""
        self._process.communicate()


def pairs_of(trees: tuple[Tree, Tree], row: str, arguments: argparse.Namespace) -> tuple[list[list[float]], bool]:
    """Time a row in turns; return old and new seconds of each pair of turns, and whether the bits are the same."""
    first = [tree.ask(row, 0) for tree in trees]
    longest = max(answer["seconds"] * answer["each"] for answer in first)
    calls = int(min(max(arguments.seconds / longest, 1), MOST_CALLS))
    pairs = []
    for turn in range(arguments.turns):
        order = (0, 1) if turn % 2 == 0 else (1, 0)
        seconds = {number: trees[number].ask(row, calls)["seconds"] for number in order}
        pairs.append([seconds[0], seconds[1]])
    return pairs, first[0]["digest"] == first[1]["digest"]


def measure(backend: str, arrays: Path, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Measure all rows of one device."""
    found: dict[str, dict[str, Any]] = {}
    for block in range(arguments.blocks):
        places = (arguments.old, arguments.new)
        # The process that goes first alternates from block to block.
        made = {number: Tree(places[number], arrays, backend) for number in ((0, 1) if block % 2 == 0 else (1, 0))}
        trees = made[0], made[1]
        about = trees[0].about
        try:
            for row in about["rows"]:
                if row not in trees[1].about["rows"] or not any(part in row for part in arguments.rows or [""]):
                    continue
                pairs, same = pairs_of(trees, row, arguments)
                one = found.setdefault(
                    row, {"backend": about["backend"], "device": about["device"], "what": row, "same_bits": True,
                          "pairs": []}
                )  # fmt: skip
                one["pairs"].append(pairs)
                one["same_bits"] &= same
                note(f"block {block + 1}: " + table_line(cells(summary(one, arguments.limit))))
        finally:
            for tree in trees:
                tree.close()
    return [summary(one, arguments.limit) for one in found.values()]


def summary(row: dict[str, Any], limit: float) -> dict[str, Any]:
    """Add medians, quartiles and whether the new tree is slower to the seconds of a row."""
    seconds = np.array(row["pairs"])
    ratios = seconds[..., 1] / seconds[..., 0]
    low, middle, high = np.quantile(ratios, (0.25, 0.5, 0.75)).tolist()
    blocks = np.median(ratios, axis=1).tolist()
    old, new = np.median(seconds, axis=(0, 1)).tolist()
    shortest = float(np.divide(*seconds.min(axis=(0, 1))[::-1]))
    return {
        **row, "old_s": old, "new_s": new, "ratio": middle, "quartiles": [low, high], "blocks": blocks,
        "shortest": shortest, "slower": min(low, *blocks, shortest) > limit,
    }  # fmt: skip


def cells(r: dict[str, Any]) -> list[str]:
    """Format the cells of a row."""
    low, high = r["quartiles"]
    blocks = ", ".join(f"{ratio:.3f}" for ratio in r["blocks"])
    return [
        r["backend"], r["what"], f"{r['old_s'] * 1e3:.4g}", f"{r['new_s'] * 1e3:.4g}", f"{r['ratio']:.3f}",
        f"{low:.3f} to {high:.3f}", blocks, f"{r['shortest']:.3f}",
        "same" if r["same_bits"] else "other", "slower" if r["slower"] else "",
    ]  # fmt: skip


def main(argv: Sequence[str]) -> int:
    """Compare the trees and publish the table."""
    parser = make_parser(__doc__)
    parser.add_argument("--old", type=Path, required=True, help="a checkout")
    parser.add_argument("--new", type=Path, default=ROOT, help="a checkout (default: this one)")
    parser.add_argument("--rows", nargs="+", help="only rows whose labels have one of these words in them")
    parser.add_argument("--particles", type=int, default=100_000)
    parser.add_argument("--beams", type=int, default=180)
    parser.add_argument("--blocks", type=int, default=4, help="pairs of processes (default: %(default)s)")
    parser.add_argument("--turns", type=int, default=8, help="of each tree in a block (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=0.1, help="of a turn (default: %(default)s)")
    parser.add_argument("--limit", type=float, default=1.02, help="a slower row's ratio (default: %(default)s)")
    parser.add_argument("--bits", action="store_true", help="fail where a result has other bits")
    add_scene(parser, 100.0)
    arguments = parse(parser, argv)
    with tempfile.TemporaryDirectory() as folder:
        arrays = Path(folder) / "arrays.npz"
        label = write_arrays(arrays, arguments)
        rows = [row for backend in arguments.backend for row in measure(backend, arrays, arguments)]
    slower = [row for row in rows if row["slower"]]
    remark = (
        f"{len(slower)} of {len(rows)} rows are slower by more than {100 * (arguments.limit - 1):.3g} %; "
        f"{sum(not row['same_bits'] for row in rows)} have other bits. The median of all rows' ratios is "
        f"{np.median([row['ratio'] for row in rows]):.3f}. {arguments.blocks} blocks of {arguments.turns} turns of "
        f"{arguments.seconds:g} s. Scene: {label}."
    )
    report = {"old": arguments.old.name, "new": arguments.new.name, "scene": label, "rows": rows}
    publish(str(SCRIPT), arguments, table(COLUMNS, map(cells, rows)), report, remark)
    return int(bool(slower) or (arguments.bits and not all(row["same_bits"] for row in rows)))
