"""Options, scenes, timings and reports that the scripts of ``bench/`` share.

A script runs from a checkout, with an installed gpusense: ``python bench/speed/limits.py ...``. Its line
``sys.path.insert(0, str(Path(__file__).resolve().parents[1]))`` makes this file and its sibling folders importable.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.backends.base import Backend, Launcher, Recording
from gpusense.backends.proxy import Proxy
from gpusense.commands.output import machine
from gpusense.evaluation.log_steps import read_steps, with_poses
from gpusense.evaluation.worlds import building, cloud_around, cloud_uniform, free_pose, simulate_scan
from gpusense.interface.launches import Launch, Program

ROOT = Path(__file__).resolve().parents[1]
FIGURES = ROOT / "docs" / "img"
MODELS = {"beam model": gs.BeamModel, "field": gs.LikelihoodFieldModel}
# Logs of SICK lasers among the recorded data.
LOGS = ("intel", "freiburg-079", "csail", "aces")
# A rate counts if no error is larger [eps (1 + |log p|) for each reading].
MOST_EPS = 16.0

# Environment variable with the script that runs another one, such as speed/as_avx2.py; it joins the report's command.
THROUGH = "GPUSENSE_BENCH_THROUGH"

# ---- options


def make_parser(
    doc: str | None, *, backend: str = "present", data: bool = False, seed: bool = True
) -> argparse.ArgumentParser:
    """Make a parser with the options that the scripts share."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    if backend in ("present", "kernels"):
        which = "every device present" + (" but NumPy" if backend == "kernels" else "")
        parser.add_argument("--backend", action="append", help=f"selection string, repeatable; default: {which}")
        parser.set_defaults(numpy=backend == "present")
    elif backend:
        parser.add_argument("--backend", default=backend, help="selection string (default: %(default)s)")
    if data:
        parser.add_argument("--data", type=Path, default=os.environ.get("GPUSENSE_DATA"), help="default: GPUSENSE_DATA")
    if seed:
        parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commit", default="", help="for a copy of the tree that is no git repository")
    parser.add_argument("--output", type=Path, help="path without ending for the .json and .md files")
    return parser


def add_repeats(parser: argparse.ArgumentParser, repeats: int, seconds: float) -> None:
    """Add ``--repeats`` and ``--seconds``, the limits of what :func:`best` does."""
    parser.add_argument("--repeats", type=int, default=repeats, help="of each figure (default: %(default)s)")
    parser.add_argument(
        "--seconds", type=float, default=seconds, help="longest time of the repeats of a figure (default: %(default)s)"
    )


def add_scene(parser: argparse.ArgumentParser, size: float, range_max: float = 30.0) -> None:
    """Add the options of :class:`Scene`."""
    parser.add_argument(
        "--size", type=float, default=size, help="side of the built-in building [m] (default: %(default)s)"
    )
    parser.add_argument("--map", type=Path, help="a map_server YAML in place of the built-in building")
    parser.add_argument("--range-max", type=float, default=range_max, help="of the scanner [m] (default: %(default)s)")


def parse(parser: argparse.ArgumentParser, argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Parse a script's arguments and fill in the devices; exit with an error where the recorded data is missing."""
    arguments = parser.parse_args(argv)
    if getattr(arguments, "data", True) is None:
        parser.error("--data or GPUSENSE_DATA must name the folder of recorded data")
    if getattr(arguments, "data", None) is not None:
        os.environ["GPUSENSE_DATA"] = str(arguments.data)
    if getattr(arguments, "backend", True) is None:
        arguments.backend = present(numpy=arguments.numpy)
    return arguments


def part_of(text: str) -> tuple[int, int]:
    """Return i and n of the option "i/n": the i-th of n parts."""
    first, count = map(int, text.split("/"))
    if not 1 <= first <= count:
        raise argparse.ArgumentTypeError(f"must be i/n with 1 <= i <= n, got {text}")
    return first, count


def stated_commit(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> str:
    """Return ``--commit``, or the checkout's commit; exit with an error where it has changes that no commit has."""
    stated = arguments.commit or commit() or ""
    if not stated or stated.endswith("+"):
        parser.error(f"--commit: the checkout must have no uncommitted changes, got {stated or 'no repository'}")
    return stated


def present(*, numpy: bool = True) -> list[str]:
    """List the selection strings of the machine's devices, without simulators."""
    found = [device for device in gs.devices() if device.available and device.kind != "simulator"]
    return [device.selection for device in found if numpy or device.backend != "numpy"]


# ---- scenes


class Scene:
    """A map with a pose in it, from the options of :func:`add_scene` and ``--seed``.

    Attributes:
        grid: The map: the built-in building, or the one that ``--map`` names.
        pose: A free pose in it.
    """

    def __init__(self, arguments: argparse.Namespace) -> None:
        self.rng = np.random.default_rng(arguments.seed)
        self.grid = gs.read_map(arguments.map) if arguments.map else building(arguments.seed, (arguments.size,) * 2)
        self.pose = free_pose(self.grid, self.rng, 0.3)
        self.range_max = arguments.range_max
        name = arguments.map.name if arguments.map else "built-in building"
        self.label = f"{name}, {self.grid.shape[0]} x {self.grid.shape[1]} cells, range_max {self.range_max:g}"

    def cloud(self, kind: str, count: int, spread: tuple[float, float] = (0.3, 0.1)) -> np.ndarray:
        """Draw (count, 3) poses: "global" over the map, or "tracking" around the pose [m, rad]."""
        if kind == "global":
            return cloud_uniform(self.grid, count, self.rng)
        return cloud_around(self.pose, count, *spread, self.rng)

    def scanner(self, beams: int) -> gs.Scanner:
        """Make a scanner that looks all around."""
        return gs.Scanner(np.linspace(-np.pi, np.pi, beams, endpoint=False), self.range_max)

    def scan(self, scanner: gs.Scanner) -> np.ndarray:
        """Cast a scan at the pose, without noise and with a range for each beam."""
        ranges = gs.RayCaster(self.grid, self.range_max, backend="numpy").cast(self.pose[None], scanner.bearings)[0]
        return np.minimum(ranges, self.range_max - 0.1)

    def noisy_scan(self, scanner: gs.Scanner, backend: Any = "numpy") -> np.ndarray:
        """Draw a scan at the pose from the beam model with default parameters; some beams have no return."""
        return simulate_scan(self.grid, scanner, self.pose, gs.BeamParameters(), self.rng, backend)


def middle_pose(grid: gs.OccupancyGrid) -> np.ndarray:
    """Return a pose in a free cell in the middle of the map's rows and columns of free cells."""
    row, column = (int(index[len(index) // 2]) for index in np.nonzero(grid.free))
    x0, y0, _ = grid.origin
    return np.array([x0 + (column + 0.5) * grid.resolution, y0 + (row + 0.5) * grid.resolution, 0.3])


def odd_scans(data: Path, name: str, limit: int | None = None) -> tuple[gs.OccupancyGrid, list[Any]]:
    """Read the 5 cm map of a log's even scans, and its odd scans with their logged poses."""
    folder = data / "carmen_logs"
    grid = gs.read_map(folder / "derived_maps" / f"{name}_even_05cm.yaml")
    log = folder / f"{name}-corrected.log.gz"
    return grid, with_poses(read_steps(log, every=2, offset=1, limit=limit), log)


# ---- launches


@dataclass(frozen=True)
class Started:
    """A recorded launch that can be started again."""

    launch: Launch
    launcher: Launcher

    def __call__(self) -> None:
        """Start it."""
        self.launcher(self.launch.size, *self.launch.arguments)


class Recorder(Proxy):
    """A proxy of a backend that records launches, so that they can be timed alone."""

    def __init__(self, backend: Backend) -> None:
        super().__init__(backend)
        self.launches: list[Started] = []
        self._listening = False

    @property
    def watched(self) -> Backend:
        """The backend behind this one."""
        return self._backend

    @property
    def in_batch(self) -> bool:
        """See Backend.in_batch; while launches are recorded, each copy and launch is started alone."""
        return not self._listening and super().in_batch

    def record(self, program: Program) -> Recording:
        """See Backend.record; recordings are the backend's own unless launches are recorded."""
        return super().record(program) if self._listening else self._backend.record(program)

    def replay(self, recording: Recording) -> None:
        """See Backend.replay."""
        if self._listening:
            super().replay(recording)
        else:
            self._backend.replay(recording)

    def launches_of(self, run: Callable[[], Any]) -> list[Started]:
        """Run a call and return its launches, without those that bound its poses: the host reads their result first."""
        self.launches.clear()
        self._listening = True
        try:
            run()
        finally:
            self._listening = False
        launches, self.launches = self.launches, []
        return [one for one in launches if one.launch.kernel != "bound_numbers"]

    def compile(self, kernel: str, flags: frozenset[str]) -> Any:
        """Return the backend's launcher, recorded with its arguments."""
        launcher = super().compile(kernel, flags)

        def launch(size: tuple[int, ...], *arguments: Any) -> None:
            self.launches.append(Started(Launch(kernel, flags, size, arguments), launcher))
            launcher(size, *arguments)

        return launch


def one_by_one(launches: Sequence[Callable[[], None]]) -> Callable[[], None]:
    """Make a function that starts launches one after the other."""

    def start() -> None:
        for launch in launches:
            launch()

    return start


def as_a_call(device: Any, launches: Sequence[Started]) -> Callable[[], None]:
    """Make a function that starts launches as a call does: on CUDA devices as one graph."""
    if device.info.kind != "gpu":
        return one_by_one(launches)
    replay = device.record(tuple(one.launch for one in launches))
    # The first replay starts each launch alone, the second one captures the graph.
    replay()
    replay()
    device.synchronize()
    return replay


def waited(device: Any, start: Callable[[], Any], times: int = 1) -> Callable[..., None]:
    """Make a function that starts something repeatedly and waits for the device once."""

    def run(*_: Any) -> None:
        for _ in range(times):
            start()
        device.synchronize()

    return run


# ---- arrays


def on_device(device: Any, array: np.ndarray) -> Any:
    """Copy an array to a GPU, as an array of the library that drives it."""
    if device.info.backend == "opencl":
        import pyopencl.array

        # The queue belongs to the backend behind the recorder.
        queue = device.watched.queue if isinstance(device, Recorder) else device.queue
        return pyopencl.array.to_device(queue, array)
    import warp as wp

    return wp.array(array, device=device.info.selection.removeprefix("warp:"))


def on_host(array: Any) -> np.ndarray:
    """Copy an array of any library to NumPy."""
    return np.array(array if isinstance(array, np.ndarray) else array.get() if hasattr(array, "get") else array.numpy())


def differing_bits(one: Any, other: Any) -> int:
    """Count the float32 values whose bits differ."""
    return int(np.count_nonzero(on_host(one).view(np.uint32) != on_host(other).view(np.uint32)))


# ---- times


def best(run: Callable[[], Any], repeats: int, longest: float, least: int = 1) -> tuple[float, float]:
    """Return the shortest and the median time of calls [s].

    ``longest``: The most time of all calls together [s]; fewer calls are made where they would take longer.
    """
    times: list[float] = []
    while len(times) < repeats and (len(times) < least or sum(times) + times[-1] < longest):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return min(times), float(np.median(times))


@dataclass(frozen=True)
class Way:
    """One of several ways to the same result.

    Attributes:
        run: Takes the number of a call.
        around: Makes the context in which a turn runs.
        each: The number of calls that ``run`` makes.
    """

    run: Callable[[int], Any]
    around: Callable[[], contextlib.AbstractContextManager[Any]] = contextlib.nullcontext
    each: int = 1


def in_turns(ways: Sequence[Way], calls: int, turn: int = 1, seconds: float = 0.0) -> list[list[float]]:
    """Time ways in turns for at least some calls and seconds; return the seconds of each call, for each way."""
    times: list[list[float]] = [[] for _ in ways]
    begin = time.perf_counter()
    while len(times[0]) < calls or time.perf_counter() - begin < seconds:
        for way, taken in zip(ways, times, strict=True):
            with way.around():
                if turn > 1:
                    way.run(0)
                for number in range(min(turn, calls)):
                    start = time.perf_counter()
                    way.run(number)
                    taken.append((time.perf_counter() - start) / way.each)
    return times


# ---- reports


def note(text: str) -> None:
    """Print a line of progress."""
    print(text, file=sys.stderr, flush=True)


def table_line(cells: Iterable[Any]) -> str:
    """Format a row of a Markdown table."""
    return "| " + " | ".join(map(str, cells)) + " |"


def table(columns: Sequence[str], rows: Iterable[Iterable[Any]]) -> str:
    """Format a Markdown table."""
    return "\n".join([table_line(columns), "| --- " * len(columns) + "|", *map(table_line, rows)])


def git(*words: str, root: Path = ROOT) -> str:
    """Return the output of git."""
    command = ["git", "-C", str(root), *words]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout.strip()


def commit() -> str | None:
    """Return the commit of this checkout, with a plus if files differ; None outside a checkout."""
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        return git("rev-parse", "--short=12", "HEAD") + ("+" if git("status", "--porcelain", "-uno") else "")
    return None


def command_line(script: str) -> str:
    """Return the command as typed, with absolute paths cut to their last part."""
    words = [Path(word).name if Path(word).is_absolute() else word for word in sys.argv[1:]]
    return shlex.join(["python", *os.environ.get(THROUGH, "").split(), script, *words])


def publish(script: str, arguments: argparse.Namespace, text: str, report: dict[str, Any], remark: str = "") -> None:
    """Print a script's tables, then machine and command, and write them and the report to ``--output``."""
    command = command_line(Path(script).resolve().relative_to(ROOT).as_posix())
    if getattr(arguments, "data", None) is not None:
        # The path of the data means nothing on other machines.
        command = command.replace(str(arguments.data), "DATA")
    host = {"date": time.strftime("%Y-%m-%d"), "commit": arguments.commit or commit() or "unknown", **machine()}
    described = ", ".join(f"{name} {value}" for name, value in host.items())
    text = f"{text}\n\n{remark and remark + ' '}Machine: {described}. Command: `{command}`.\n"
    print(text)
    if arguments.output:
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        document = json.dumps({"command": command, "machine": host, **report}, indent=1)
        arguments.output.with_suffix(".json").write_text(document + "\n")
        arguments.output.with_suffix(".md").write_text(text)
