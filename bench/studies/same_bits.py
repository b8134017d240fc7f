"""Same bits: does a change of the code leave every number that the package computes as it was?

    PYTHONPATH=old python bench/studies/same_bits.py record --rays 2000000 --models 15000 --output old.json
    PYTHONPATH=new python bench/studies/same_bits.py record --rays 2000000 --models 15000 --output new.json
    python bench/studies/same_bits.py compare old.json new.json

``record`` draws cases from fixed seeds, runs them with the package that Python finds, through its public interface
alone, and keeps a digest of every result: rays by every caster, likelihoods by every model in many configurations,
bound calls, arrays on the device, tables of maps. ``compare`` says what differs; exit code 1 where anything does.

Maps, poses and readings are drawn to be awkward, as in bench/accuracy/fuzz_rays.py. A case depends on its
configuration and its number alone, and cases of a configuration share models, so ``--part 0/4`` to ``--part 3/4`` may
run beside each other; ``compare old.json new-0.json new-1.json ...`` takes parts together. Run both sides on one
machine with the same options. ``--as-gpu`` (OpenCL) lets a processor pass for a GPU, whose launches are others: this
alone reaches for a name that is not public, ``gpusense.backends.get_backend``. ``--only`` takes the configurations
with these words in their names.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import platform
import shlex
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from bits.actions import ACTIONS, BEARINGS_OF_RAYS, POSES_OF_RAYS, act_rays, on_host
from bits.cases import Case, Device, Outcome, World, draw_world, seeds
from bits.configurations import configurations
from bits.devices import devices_of
from bits.models import make_models

import gpusense as gs

# Cases that share a model, and numbers of a result that are shown.
ROUND, SHOWN = 10, 3


def digest(label: str, value: Any) -> list[Any]:
    """Return what is kept of a result: label, how many numbers, their kind and shape, a digest, and the first few."""
    if isinstance(value, str):
        return [label, 0, "text", value]
    array = on_host(value)
    what = f"{array.dtype.str}{array.shape}".replace(" ", "")
    found = hashlib.blake2b(what.encode() + np.ascontiguousarray(array).tobytes(), digest_size=12).hexdigest()
    return [label, array.size, what, found, *(repr(each.item()) for each in array.reshape(-1)[:SHOWN])]


def outcome_of(action: Callable[[Case], Outcome], case: Case) -> list[list[Any]]:
    """Return what is kept of a case: results, and the error that ended it."""
    kept = []
    try:
        for label, value in action(case):
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
        """Keep a case, and say now and then how many there are."""
        self.cases[name] = kept
        self.numbers += sum(each[1] for each in kept)
        self.errors += sum(each[0].startswith("error") for each in kept)
        if (now := time.perf_counter()) - self._said > 15:
            self._said = now
            print(f"{now - self._begin:6.0f} s  {self.summary()}, at {name}", file=sys.stderr, flush=True)

    def summary(self) -> str:
        """Return counts in words."""
        return f"{len(self.cases)} cases, {self.rays} rays, {self.numbers} numbers, {self.errors} errors"


def record_rays(record: Record, arguments: argparse.Namespace, devices: tuple[Device, Device]) -> None:
    """Cast rays until enough are cast."""
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


def record_command(arguments: argparse.Namespace) -> int:
    """Record what the package computes."""
    plain, there, info = devices_of(arguments.backend, arguments.as_gpu)
    record, begin = Record(), time.perf_counter()
    np.seterr(all="ignore")
    if any(word in "rays" for word in arguments.only):
        record_rays(record, arguments, (plain, there))
    record_models(record, arguments, (plain, there))
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
    """Find the results of a case that differ."""
    for one, other in itertools.zip_longest(old, new):
        both = one is not None and other is not None and one[:3] == other[:3]
        texts = both and one[2] == "text" and not messages
        if not both or (one[3:] != other[3:] and not texts):
            yield one, other


def compare_command(arguments: argparse.Namespace) -> int:
    """Compare a record with another one, which may be in parts."""
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


def part_of(text: str) -> tuple[int, int]:
    """Read which part of how many."""
    part, parts = (int(number) for number in text.split("/"))
    if not 0 <= part < parts:
        raise argparse.ArgumentTypeError(f"must be i/n with 0 <= i < n, got {text}")
    return part, parts


def main() -> int:
    """Record or compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    record = commands.add_parser("record", help="record what the package computes")
    record.add_argument("--backend", default="opencl", help="selection string")
    record.add_argument("--rays", type=int, default=2_000_000)
    record.add_argument("--models", type=int, default=15_000, help="cases of models")
    record.add_argument("--seed", type=int, default=0)
    record.add_argument("--part", type=part_of, default=(0, 1), metavar="I/N", help="only the I-th of N parts")
    record.add_argument("--only", nargs="+", default=[""], metavar="WORDS", help="configurations with these words")
    record.add_argument("--as-gpu", action="store_true", help="take a processor for a GPU")
    record.add_argument("--output", type=Path, required=True)
    record.set_defaults(run=record_command)
    compare = commands.add_parser("compare", help="compare two records")
    compare.add_argument("old", type=Path)
    compare.add_argument("new", type=Path, nargs="+", help="a record, or its parts")
    compare.add_argument("--messages", action="store_true", help="compare texts too: messages of errors, explain()")
    compare.set_defaults(run=compare_command)
    arguments = parser.parse_args()
    return int(arguments.run(arguments))


if __name__ == "__main__":
    sys.exit(main())
