"""Measure time and peak memory of large maps: built from scans, and read from images.

    python bench/speed/map_memory.py --side 8000 --side 20000 --tree ../main:before --tree .:after

Each figure comes from a separate process that has built or read a small map before. Memory is the growth of the
resident set to its peak during the call, per cell of the map. Built maps hold ``--scans`` scans of 360 beams up to 20 m
at random poses, with cells of 5 cm; images have random greys of map_saver, and PNGs of 1 bit are black. ``--tree``
measures several checkouts in turn.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import ROOT, make_parser, note, parse, publish, table

COLUMNS = ("what", "side, cells", "tree", "seconds", "processor, s", "peak, bytes a cell", "result, SHA-256")
IMAGES = ("PGM", "PNG, 8 bits", "PNG, 1 bit")

# The program of each process; its argument is a JSON list: what, side, scans, seed, folder.
_CHILD = r"""
import hashlib, json, pathlib, sys, time, zlib, struct
import numpy as np
import gpusense as gs

what, side, scans, seed, folder = json.loads(sys.argv[1])

def status(name):
    lines = pathlib.Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(name + ":"))

def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

def image(name, side):
    rng, path = np.random.default_rng(seed), pathlib.Path(folder, f"{name[:3]}{name[5:6]}{side}")
    block = rng.choice(np.array([0, 254, 205], np.uint8), (64, side))
    rows = (block[i % 64].tobytes() for i in range(side))
    with path.with_suffix(".img").open("wb") as stream:
        if name == "PGM":
            stream.write(b"P5\n%d %d\n255\n" % (side, side))
            for row in rows:
                stream.write(row)
        else:
            bits = 1 if name.endswith("1 bit") else 8
            packer = zlib.compressobj(6)
            stream.write(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, bits, 0, 0, 0, 0)))
            black = bytes(-(-side // 8))
            for row in rows:
                data = packer.compress(b"\0" + (black if bits == 1 else row))
                if data:
                    stream.write(chunk(b"IDAT", data))
            stream.write(chunk(b"IDAT", packer.flush()) + chunk(b"IEND", b""))
    path.with_suffix(".yaml").write_text(
        f"image: {path.name}.img\nresolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    return path.with_suffix(".yaml")

def build(side, scans):
    rng = np.random.default_rng(seed)
    scanner = gs.Scanner.uniform(angle_min=-3.1, angle_increment=6.2 / 360, count=360, range_max=30.0)
    size = 0.05 * side
    poses = np.column_stack([rng.uniform(0, size, (scans, 2)), rng.uniform(-3, 3, scans)])
    ranges = rng.uniform(2, 20, (scans, 360))
    options = dict(resolution=0.05, origin=(0, 0, 0), shape=(side, side), backend=what)
    return lambda: gs.build_map(ranges, poses, scanner, **options)

if what[:3] in ("PGM", "PNG"):
    small, large = (lambda file=image(what, n): gs.read_map(file) for n in (50, side))
else:
    small, large = build(50, 3), build(side, scans)
small()
# The peak begins anew where the system allows it.
try:
    pathlib.Path("/proc/self/clear_refs").write_text("5")
except OSError:
    pass
before, begin, spent = status("VmRSS"), time.perf_counter(), time.process_time()
grid = large()
seconds, spent = time.perf_counter() - begin, time.process_time() - spent
peak = status("VmHWM") - before
print(json.dumps([seconds, spent, peak / grid.cells.size, hashlib.sha256(grid.cells).hexdigest()[:16]]))
"""


def figures(tree: Path, task: list[Any]) -> list[Any]:
    """Return the seconds, processor seconds, bytes a cell and checksum of one run."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, (str(tree), os.environ.get("PYTHONPATH"))))}
    # Modules of the working directory are not imported.
    command = [sys.executable, "-P", "-W", "ignore", "-c", _CHILD, json.dumps(task)]
    done = subprocess.run(command, env=environment, cwd=task[-1], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{tree}: {done.stderr[-2000:]}")
    result: list[Any] = json.loads(done.stdout.splitlines()[-1])
    return result


def main() -> int:
    """Measure and write."""
    parser = make_parser(__doc__)
    parser.add_argument("--side", type=int, action="append", help="of the map [cells], repeatable; default: 8000")
    parser.add_argument("--scans", type=int, default=2000, help="of a built map (default: %(default)s)")
    parser.add_argument("--image", action="append", choices=IMAGES, help="repeatable; default: all, none with --built")
    parser.add_argument("--built", action="store_true", help="measure no images")
    parser.add_argument("--repeats", type=int, default=1, help="runs of a figure (default: %(default)s)")
    parser.add_argument(
        "--tree", action="append", default=[], metavar="PATH:NAME", help="a checkout (default: this one)"
    )
    arguments = parse(parser)
    texts = arguments.tree or [f"{ROOT}:this"]
    trees = [(Path(path).resolve(), name) for path, _, name in (text.rpartition(":") for text in texts)]
    rows = []
    for what in [*arguments.backend, *([] if arguments.built else arguments.image or IMAGES)]:
        for side in arguments.side or [8000]:
            runs: dict[str, list[list[Any]]] = {name: [] for _, name in trees}
            for _ in range(arguments.repeats):
                for tree, name in trees:
                    with tempfile.TemporaryDirectory() as folder:
                        task = [what, side, arguments.scans, arguments.seed, folder]
                        runs[name].append(figures(tree, task))
                        note(f"{what}, {side}, {name}: {runs[name][-1]}")
            for name, each in runs.items():
                numbers = [median(run[k] for run in each) for k in range(3)]
                (checksum,) = {run[3] for run in each}
                rows.append([what, side, name, *(f"{number:.2f}" for number in numbers), checksum])
    remark = f"Median of {arguments.repeats} runs; {arguments.scans} scans in built maps."
    publish(
        __file__, arguments, table(COLUMNS, rows), {"rows": [dict(zip(COLUMNS, r, strict=True)) for r in rows]}, remark
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
