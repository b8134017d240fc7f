"""Compare the bits of two trees: does a change of the code change any number that the package computes?

    python bench/compare_trees.py bits --old ../before --rays 2000000 --models 15000

    PYTHONPATH=old python bench/compare_trees.py record --rays 2000000 --models 15000 --output old.json
    PYTHONPATH=new python bench/compare_trees.py record --rays 2000000 --models 15000 --output new.json
    python bench/compare_trees.py compare old.json new.json

``record`` draws cases from fixed seeds, runs them with the package that Python finds, through its public interface
alone, and keeps a digest of every result: rays by every caster, likelihoods by every model in many configurations,
bound calls, arrays on the device, tables of maps, steps of filters, matches of scans. ``compare`` lists differences,
and its exit code is 1 if there are any. ``bits`` records both trees, one after the other, and compares them.

Maps, poses and readings are drawn to be awkward, as in bench/accuracy/fuzz_rays.py. A case depends only on its
configuration and its number, and the cases of a configuration share models, so ``--part 0/4`` to ``--part 3/4`` may
run at the same time; ``compare old.json new-0.json new-1.json ...`` joins the parts. Run both sides on one machine with
the same options. ``--as-gpu`` (OpenCL) makes a processor pass for a GPU, whose launches differ; only this option uses a
name that is not public, ``gpusense.backends.get_backend``. ``--only`` selects the configurations with these words in
their names; rays, filters and matches are also configurations.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import os
import platform
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from trees.actions import ACTIONS, BEARINGS_OF_RAYS, POSES_OF_RAYS, act_rays, on_host
from trees.cases import Case, Device, Outcome, World, devices_of, draw_world, seeds
from trees.configurations import configurations, make_models

ROOT, SCRIPT = Path(__file__).resolve().parents[2], Path(__file__).resolve().parents[1] / "compare_trees.py"
# Cases of a model, and values of a result to show.
ROUND, SHOWN = 10, 3


def digest(label: str, value: Any) -> list[Any]:
    """Return the record of a result: label, number of values, dtype and shape, a digest, and the first few values."""
    if isinstance(value, str):
        return [label, 0, "text", value]
    array = on_host(value)
    what = f"{array.dtype.str}{array.shape}".replace(" ", "")
    found = hashlib.blake2b(what.encode() + np.ascontiguousarray(array).tobytes(), digest_size=12).hexdigest()
    return [label, array.size, what, found, *(repr(each.item()) for each in array.reshape(-1)[:SHOWN])]


def outcome_of(action: Callable[[Case], Outcome], case: Case) -> list[list[Any]]:
    """Return the record of a case: its results, and the error that ended it."""
    return kept_of(results_of(action, case))


def results_of(action: Callable[[Case], Outcome], case: Case) -> Iterator[tuple[str, Any]]:
    """Yield the results of a case."""
    yield from action(case)


def kept_of(results: Iterable[tuple[str, Any]]) -> list[list[Any]]:
    """Return the record of results, and of the error that ended them."""
    kept = []
    try:
        for label, value in results:
            kept.append(digest(label, value))
    except Exception as error:
        kept.append([f"error {type(error).__name__}", 0, "text", str(error)])
    return kept


class Record:
    """Collect the results of cases, and print the progress."""

    def __init__(self) -> None:
        self.cases: dict[str, list[list[Any]]] = {}
        self.numbers = self.rays = self.errors = 0
        self._begin = self._said = time.perf_counter()

    def add(self, name: str, kept: list[list[Any]]) -> None:
        """Add a case, and print progress from time to time."""
        self.cases[name] = kept
        self.numbers += sum(each[1] for each in kept)
        self.errors += sum(each[0].startswith("error") for each in kept)
        if (now := time.perf_counter()) - self._said > 15:
            self._said = now
            print(f"{now - self._begin:6.0f} s  {self.summary()}, at {name}", file=sys.stderr, flush=True)

    def summary(self) -> str:
        """Return a sentence with the counts."""
        return f"{len(self.cases)} cases, {self.rays} rays, {self.numbers} numbers, {self.errors} errors"


def record_rays(record: Record, arguments: argparse.Namespace, devices: tuple[Device, Device]) -> None:
    """Cast the wanted number of rays."""
    each = POSES_OF_RAYS * BEARINGS_OF_RAYS
    part, parts = arguments.part
    for number in range(part, -(-arguments.rays // each), parts):
        rng = seeds(arguments.seed, "rays", number)
        device = devices[number % 4 == 3]
        case = Case(rng, device, {"huge": 1}, World(None, None, None, None), [])  # type: ignore[arg-type]
        record.rays += each
        record.add(f"rays/{number}", outcome_of(act_rays, case))


def record_models(record: Record, arguments: argparse.Namespace, devices: tuple[Device, Device]) -> None:
    """Run the cases of each configuration of this part, one after the other."""
    names, (part, parts) = configurations(), arguments.part
    share, rest = divmod(arguments.models, len(names))
    for i, (name, config) in enumerate(names.items()):
        if i % parts != part or not any(word in name for word in arguments.only):
            continue
        models: list[Any] = []
        for number in range(share + (i < rest)):
            again, within = divmod(number, ROUND)
            device = devices[again % 2 == 1 and config["there"]]
            if within == 0:
                rng, models = seeds(arguments.seed, name, again), []
                world, failure = draw_world(rng, config), []
                try:
                    models = make_models(config, world, device.backend, rng)
                except Exception as error:
                    failure = [[f"error {type(error).__name__}", 0, "text", str(error)]]
            case = Case(seeds(arguments.seed, name, again, within), device, config, world, models)
            record.add(f"{name}/{number}", failure or outcome_of(ACTIONS[config["kind"]], case))


def record_tasks(record: Record, arguments: argparse.Namespace) -> None:
    """Run filters and matches."""
    part, parts = arguments.part
    for kind, run in (("filters", run_filter), ("matches", run_match)):
        if not any(word in kind for word in arguments.only):
            continue
        for number in range(part, getattr(arguments, kind), parts):
            record.add(f"{kind}/{number}", kept_of(run(arguments.seed, number, arguments.backend)))


def record_command(arguments: argparse.Namespace) -> int:
    """Record what the package computes."""
    plain, there, info = devices_of(arguments.backend, arguments.as_gpu)
    record, begin = Record(), time.perf_counter()
    np.seterr(all="ignore")
    if any(word in "rays" for word in arguments.only):
        record_rays(record, arguments, (plain, there))
    record_models(record, arguments, (plain, there))
    if not arguments.as_gpu:
        record_tasks(record, arguments)
    head = {
        "command": shlex.join(["python", *sys.argv]), "date": time.strftime("%Y-%m-%d %H:%M"),
        "package": str(Path(gs.__file__).parent), "platform": platform.platform(terse=True), "numpy": np.__version__,
        "device": f"{info.selection} {info.name}, {info.driver}, {info.lanes} lanes", "seconds":
        round(time.perf_counter() - begin), "rays": record.rays, "numbers": record.numbers, "errors": record.errors,
        "arrays_on_device": there.there is not None,
    }  # fmt: skip
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(kept)}" for name, kept in record.cases.items())
    arguments.output.write_text(f'{{"head": {json.dumps(head, indent=1)},\n"cases": {{\n{lines}\n}}}}\n')
    print(json.dumps(head, indent=1))
    kinds = sorted({each[0] + ": " + name.split("/")[0] for name, kept in record.cases.items() for each in kept
                    if each[0].startswith("error")})  # fmt: skip
    print("\n".join(kinds))
    return 0


def read(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read the head and the cases of a record."""
    found = json.loads(path.read_text())
    return found["head"], found["cases"]


def differences(old: list[list[Any]], new: list[list[Any]], messages: bool) -> Iterator[tuple[Any, Any]]:
    """Yield the results of a case that differ."""
    for one, other in itertools.zip_longest(old, new):
        both = one is not None and other is not None and one[:3] == other[:3]
        texts = both and one[2] == "text" and not messages
        if not both or (one[3:] != other[3:] and not texts):
            yield one, other


def compare_command(arguments: argparse.Namespace) -> int:
    """Compare a record with another, possibly in parts."""
    head, old = read(arguments.old)
    new: dict[str, Any] = {}
    for path in arguments.new:
        own, cases = read(path)
        new |= cases
        for key in ("platform", "numpy", "device", "arrays_on_device"):
            if own[key] != head[key]:
                print(f"note: {key} is {head[key]} in {arguments.old} and {own[key]} in {path}")
    results = numbers = bad_results = bad_numbers = 0
    told: dict[str, int] = {}
    for name in sorted(set(old) | set(new)):
        one, other = old.get(name, []), new.get(name, [])
        results += max(len(one), len(other))
        numbers += sum(each[1] for each in one)
        for before, after in differences(one, other, arguments.messages):
            bad_results += 1
            bad_numbers += max(each[1] for each in (before, after) if each)
            family = name.split("/")[0]
            told[family] = told.get(family, 0) + 1
            if told[family] <= 3:
                print(f"{name}:\n  {arguments.old}: {before}\n  new: {after}")
    for family, count in told.items():
        print(f"{family}: {count} results differ")
    missing = len(set(old) ^ set(new))
    print(f"{len(set(old) & set(new))} cases compared, {missing} only in one; {results} results of {numbers} numbers")
    print(f"{bad_results} results of {bad_numbers} numbers differ")
    if not numbers:
        print("no numbers were compared: every case ended with an error")
    return int(bool(bad_results or missing or not numbers))


def bits_command(arguments: argparse.Namespace) -> int:
    """Record both trees, each in its own process, and compare the records."""
    with tempfile.TemporaryDirectory() as folder:
        records = []
        for name, tree in (("old", arguments.old), ("new", arguments.new)):
            records.append(Path(folder) / f"{name}.json")
            command = [sys.executable, "-P", str(SCRIPT), "record", "--output", str(records[-1])]
            for option in ("backend", "rays", "models", "filters", "matches", "seed"):
                command += [f"--{option}", str(getattr(arguments, option))]
            command += ["--only", *arguments.only] + ["--as-gpu"] * arguments.as_gpu
            search = os.pathsep.join(filter(None, (str(tree.resolve()), os.environ.get("PYTHONPATH"))))
            subprocess.run(command, env=os.environ | {"PYTHONPATH": search}, check=True)
            package = Path(read(records[-1])[0]["package"]).resolve()
            if not package.is_relative_to(tree.resolve()):
                raise RuntimeError(f"{tree}: must be a checkout of gpusense; {package} is imported")
        arguments.old, arguments.new = records[0], records[1:]
        return compare_command(arguments)


def part_of(text: str) -> tuple[int, int]:
    """Parse a part ``i/n``."""
    part, parts = (int(number) for number in text.split("/"))
    if not 0 <= part < parts:
        raise argparse.ArgumentTypeError(f"must be i/n with 0 <= i < n, got {text}")
    return part, parts


def add_cases(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose the cases."""
    parser.add_argument("--backend", default="opencl", help="selection string")
    parser.add_argument("--rays", type=int, default=2_000_000)
    parser.add_argument("--models", type=int, default=15_000, help="cases of models")
    parser.add_argument("--filters", type=int, default=60, help="filters, of 12 steps each")
    parser.add_argument("--matches", type=int, default=120, help="matches of scans")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", default=[""], metavar="WORDS", help="configurations with these words")
    parser.add_argument("--as-gpu", action="store_true", help="take a processor for a GPU")


def main(argv: Sequence[str]) -> int:
    """Run the subcommand: record, compare, or both."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    bits = commands.add_parser("bits", help="record both trees and compare")
    bits.add_argument("--old", type=Path, required=True, help="a checkout")
    bits.add_argument("--new", type=Path, default=ROOT, help="a checkout (default: this one)")
    add_cases(bits)
    bits.set_defaults(run=bits_command)
    record = commands.add_parser("record", help="record what the package computes")
    add_cases(record)
    record.add_argument("--part", type=part_of, default=(0, 1), metavar="I/N", help="only the I-th of N parts")
    record.add_argument("--output", type=Path, required=True)
    record.set_defaults(run=record_command)
    compare = commands.add_parser("compare", help="compare two records")
    compare.add_argument("old", type=Path)
    compare.add_argument("new", type=Path, nargs="+", help="a record, or its parts")
    compare.set_defaults(run=compare_command)
    for one in (bits, compare):
        one.add_argument("--messages", action="store_true", help="also compare texts: messages of errors, explain()")
    arguments = parser.parse_args(argv)
    return int(arguments.run(arguments))


BEAMS, RANGE, STEPS = 60, 8.0, 12
# Options of filters, assigned in turn.
FILTERS: tuple[dict[str, Any], ...] = (
    {}, {"temperature": 0.3, "stages": 1, "recovery": None}, {"particles": (50, 400)}, {"resampling": "residual"},
    {"recovery": "augmented"}, {"beam_skip": 0.3},
)  # fmt: skip
METHODS = ("icp", "gauss_newton", "correlative")


def room(rng: np.random.Generator) -> gs.OccupancyGrid:
    """Draw a room with some furniture."""
    cells = np.pad(np.zeros((80, 100), np.int8), 2, constant_values=100)
    for _ in range(8):
        row, col = rng.integers(5, 70), rng.integers(5, 90)
        cells[row : row + rng.integers(2, 8), col : col + rng.integers(2, 8)] = 100
    return gs.OccupancyGrid(cells, 0.1)


def free_pose(grid: gs.OccupancyGrid, rng: np.random.Generator) -> np.ndarray:
    """Draw a pose in free space."""
    rows, cols = np.nonzero(grid.free)
    at = rng.integers(len(rows))
    return np.array([*grid.cell_centers(rows[[at]], cols[[at]])[0], rng.uniform(-np.pi, np.pi)])


def run_filter(seed: int, number: int, backend: str) -> Iterator[tuple[str, Any]]:
    """Yield particles, weights and estimates of a filter after each step."""
    rng = seeds(seed, "filters", number)
    grid, scanner = room(rng), gs.Scanner(np.linspace(-np.pi, np.pi, BEAMS, endpoint=False), RANGE)
    kind = (gs.LikelihoodFieldModel, gs.BeamModel)[number % 2]
    options = {"particles": 200, "seed": number} | FILTERS[number % len(FILTERS)]
    pf = gs.ParticleFilter(kind(grid, scanner, backend=backend), **options)
    pose, caster = free_pose(grid, rng), gs.RayCaster(grid, RANGE, backend="numpy")
    if number % 3 == 2:
        pf.initialize_uniform()
    else:
        pf.initialize(mean=pose, covariance=np.diag([0.04, 0.04, 0.01]))
    for step in range(STEPS):
        after = pose + np.array([0.03 * np.cos(pose[2]), 0.03 * np.sin(pose[2]), rng.normal(0, 0.05)])
        pf.predict(pose, after)
        pose = after
        ranges = caster.cast(pose[None], scanner.bearings)[0] + rng.normal(0, 0.02, BEAMS)
        pf.correct(ranges)
        estimate = pf.estimate()
        yield f"particles {step}", pf.host_particles()
        yield f"weights {step}", pf.host_weights()
        yield f"estimate {step}", np.array([*estimate.pose, *estimate.covariance.ravel(), estimate.p_lost])


def run_match(seed: int, number: int, backend: str) -> Iterator[tuple[str, Any]]:
    """Yield poses and covariances of a match to a scan, or to a map."""
    rng = seeds(seed, "matches", number)
    grid, scanner = room(rng), gs.Scanner(np.linspace(-np.pi, np.pi, 180, endpoint=False), RANGE)
    pose, caster = free_pose(grid, rng), gs.RayCaster(grid, RANGE, backend="numpy")
    moved = pose + rng.normal(0, (0.1, 0.1, 0.05))
    scans = caster.cast(np.stack([pose, moved]), scanner.bearings) + rng.normal(0, 0.01, (2, 180))
    if number % 2:
        match = gs.match_scan(grid, scans[1], scanner, pose, backend=backend)
    else:
        match = gs.match_scan(scans[0], scans[1], scanner, method=METHODS[number // 2 % 3], backend=backend)
    for name in ("pose", "covariance", "p_right"):
        yield name, np.asarray(getattr(match, name))
