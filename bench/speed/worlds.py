"""Compare rays in many worlds at once with rays in one map; measure moving shapes and replaced worlds.

    python bench/speed/worlds.py --backend opencl --worlds 64,1024
    python bench/speed/worlds.py --backend warp:cuda:0 --worlds 256,1024,4096,8192 --shapes 64 --kernels

Every world is a room of 256 x 256 cells with boxes in it, each with 16 robots of 360 beams. A single room has as many
robots as the worlds, and takes turns with them. Rates time whole calls and, after a slash, bound calls. Models
score one scan. Poses, indices and ranges are in a GPU's memory, for processors in the host's. --kernels adds the time
of each launch by the device's clock. --peers casts lidars among discs in worlds without walls, and runs VMAS and ir-sim
on the same scene where they are installed.
"""

from __future__ import annotations

import argparse
import functools
import importlib.util
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.backends import get_backend, processor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import Recorder, add_repeats, make_parser, note, on_device, parse, publish, table

SIDE, ROBOTS, RESOLUTION, RANGE_MAX = 256, 16, 0.05, 10.0
BEARINGS = np.linspace(-np.pi, np.pi, 360, endpoint=False)
COLUMNS = (
    "worlds|shapes|M rays/s, whole call / bound call|of one room|M readings/s, beam model / field|of one room|"
    "made [ms]|replaced [ms]|bytes a cell|launches"
)


def rooms(count: int, rng: np.random.Generator) -> np.ndarray:
    """Return cells of rooms with a wall around them and boxes in them."""
    cells = np.zeros((count, SIDE, SIDE), np.int8)
    cells[:, [0, -1]] = cells[:, :, [0, -1]] = 100
    for _ in range(12):
        row, col = rng.integers(4, SIDE - 24, (2, count))
        height, width = rng.integers(3, 20, (2, count))
        for w in range(count):
            cells[w, row[w] : row[w] + height[w], col[w] : col[w] + width[w]] = 100
    return cells


def poses_in(worlds: int, rng: np.random.Generator) -> np.ndarray:
    """Return poses of the robots of all worlds."""
    count = worlds * ROBOTS
    return np.column_stack([rng.uniform(1, SIDE * RESOLUTION - 1, (count, 2)), rng.uniform(-3, 3, count)])


clock: Callable[[], float] = time.perf_counter


def least(backend: Any, repeats: int, seconds: float, *runs: Callable[[], Any]) -> list[float]:
    """Return the least times of calls that have ended [s]; the calls take turns."""
    best, begin = [float("inf")] * len(runs), time.perf_counter()
    for turn in range(repeats + 1):
        for k, run in enumerate(runs):
            before = clock()
            run()
            backend.synchronize()
            # The first turn makes what the others keep.
            best[k] = min(best[k], clock() - before) if turn else best[k]
        if turn and time.perf_counter() - begin > seconds:
            break
    return best


def there(backend: Any, *arrays: np.ndarray) -> list[Any]:
    """Return arrays in the memory of a GPU: of PyTorch where CUDA has it, else of the library that drives it."""
    if backend.info.kind != "gpu":
        return list(arrays)
    if backend.info.backend == "warp" and importlib.util.find_spec("torch") is not None:
        import torch

        return [torch.from_numpy(array).to(backend.info.selection.removeprefix("warp:")) for array in arrays]
    return [on_device(backend, array) for array in arrays]


def shapes_of(worlds: int, count: int, rng: np.random.Generator) -> gs.Shapes:
    """Return discs, boxes and segments in equal numbers."""
    each = count // 4
    extent = SIDE * RESOLUTION
    discs = np.concatenate([rng.uniform(0, extent, (worlds, 2 * each, 2)), np.full((worlds, 2 * each, 1), 0.2)], axis=2)
    boxes = np.concatenate([rng.uniform(0, extent, (worlds, each, 3)), np.full((worlds, each, 2), 0.4)], axis=2)
    begin = rng.uniform(0, extent, (worlds, each, 2))
    return gs.Shapes(discs=discs, boxes=boxes, segments=np.concatenate([begin, begin + 0.5], axis=2))


def calls_of(place: Any, poses: Any, where: Any, backend: Any) -> list[Callable[[], Any]]:
    """Return bound casts, and calls of a beam model and a field with one scan, at all poses in worlds or a map."""
    options = {} if where is None else {"world": where}
    scanner = gs.Scanner(BEARINGS, range_max=RANGE_MAX)
    (scan,) = there(backend, np.random.default_rng(1).uniform(0.5, 9, len(BEARINGS)))
    models = [kind(place, scanner, backend=backend) for kind in (gs.BeamModel, gs.LikelihoodFieldModel)]
    bound = gs.RayCaster(place, RANGE_MAX, backend=backend).bind(poses, BEARINGS, **options)
    return [bound, *(functools.partial(model.log_likelihood, poses, scan, **options) for model in models)]


def by_events(device: Any, launches: list[Callable[[], None]]) -> list[tuple[str, float]]:
    """Return name and seconds of each launch of an OpenCL or CUDA device."""
    if device.info.backend == "warp":
        import warp as wp

        wp.timing_begin(cuda_filter=wp.TIMING_KERNEL, synchronize=True)
        for launch in launches:
            launch()
        return [(result.name, result.elapsed * 1e-3) for result in wp.timing_end(synchronize=True)]
    import pyopencl as cl

    from gpusense.backends.opencl.pocl import source_name

    before, found = device._queue, []
    device._queue = cl.CommandQueue(device._context, properties=cl.command_queue_properties.PROFILING_ENABLE)

    def enqueue(kernel: Any, size: tuple[int, ...], group: tuple[int, ...]) -> None:
        found.append(
            (source_name(kernel.function_name), cl.enqueue_nd_range_kernel(device._queue, kernel, size, group))
        )

    device.enqueue = enqueue
    try:
        for launch in launches:
            launch()
        device._queue.finish()
    finally:
        device._queue = before
        del device.enqueue
    return [(name, (event.profile.end - event.profile.start) * 1e-9) for name, event in found]


def least_by_events(device: Any, launches: list[Callable[[], None]], repeats: int) -> list[tuple[str, float]]:
    """Return name and least seconds of each launch."""
    runs = [by_events(device, launches) for _ in range(repeats)]
    names = [name.removeprefix("forward kernel ").removeprefix("make__locals__") for name, _ in runs[0]]
    return list(zip(names, np.min([[taken for _, taken in run] for run in runs], axis=0).tolist(), strict=True))


def timed(recorder: Any, run: Callable[[], Any]) -> str:
    """Return the least time of each launch of a call by the device's clock, where a recorder records launches."""
    if not isinstance(recorder, Recorder):
        return ""
    each = least_by_events(recorder.watched, recorder.launches_of(run), 5)
    return "; ".join(f"{name} {seconds * 1e6:.0f} us" for name, seconds in each)


def measure(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Measure single maps, then each number of worlds."""
    backend, rng, rows = get_backend(arguments.backend), np.random.default_rng(0), []
    numbers = [int(number) for number in arguments.worlds.split(",")]
    turns = backend, arguments.repeats, arguments.seconds
    room = gs.OccupancyGrid(rooms(1, rng)[0], RESOLUTION)
    for count in numbers:
        recorder = Recorder(backend) if arguments.kernels else backend
        kinds = rooms(min(count, 256), rng)
        cells = np.resize(kinds, (count, SIDE, SIDE))
        begin = time.perf_counter()
        worlds = gs.Worlds(cells, RESOLUTION, backend=recorder)
        caster = gs.RayCaster(worlds, RANGE_MAX, backend=recorder)
        index = np.arange(count, dtype=np.int32).repeat(ROBOTS)
        poses, where = there(backend, poses_in(count, rng), index)
        (new,), changed = there(backend, kinds), np.arange(len(kinds))

        def cast(caster: Any = caster, poses: Any = poses, where: Any = where) -> None:
            caster.cast(poses, BEARINGS, world=where)

        def replace(worlds: Any = worlds, new: Any = new, changed: Any = changed) -> None:
            worlds.replace(changed, new)

        cast()
        backend.synchronize()
        made, rays = time.perf_counter() - begin, count * ROBOTS * len(BEARINGS)
        for shapes in sorted({0, arguments.shapes}):
            if shapes:
                worlds.shapes = shapes_of(count, shapes, rng)
            (whole,), (replaced,) = least(*turns, cast), least(*turns, replace)
            pairs = zip(calls_of(worlds, poses, where, recorder), calls_of(room, poses, None, backend), strict=True)
            each = [least(*turns, *pair) for pair in pairs]
            rates, of_room = [1e-6 * rays / one for one, _ in each], [one_room / one for one, one_room in each]
            rows.append(dict(
                worlds=count, shapes=shapes, rate=1e-6 * rays / whole, rates=rates, of_room=of_room,
                made=1e3 * made, replaced=1e3 * replaced, bytes=worlds.nbytes / (count * SIDE * SIDE),
                launches="; ".join(timed(recorder, run) for run in (cast, replace)),
            ))  # fmt: skip
            note(" | ".join(line_of(rows[-1])))
        del worlds, caster, cast, replace, pairs
    return rows


def peers(arguments: argparse.Namespace) -> list[tuple[str, ...]]:
    """Measure a lidar of 64 beams in each world, among 12 discs, and steps that also move all and find collisions."""
    rng, count, rays, longest = np.random.default_rng(0), int(arguments.worlds.split(",")[0]), 64, 10.0
    away, angle = rng.uniform(0.8, 9, (count, 12)), rng.uniform(-np.pi, np.pi, (count, 12))
    poses = np.column_stack([rng.uniform(-3, 3, (count, 2)), rng.uniform(-3, 3, count)])
    centres = poses[:, None, :2] + away[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=2)
    discs = np.concatenate([centres, np.full((count, 12, 1), 0.3)], axis=2)
    backend = get_backend(arguments.backend)
    worlds = gs.Worlds(np.zeros((count, 8, 8), np.int8), 5.0, (-20.0, -20.0, 0.0), backend=backend)
    worlds.shapes = gs.Shapes(discs=discs)
    caster, index = gs.RayCaster(worlds, longest, backend=backend), np.arange(count)
    turn = np.linspace(0, 2 * np.pi, rays, endpoint=False)
    placed, where, moved, ahead, beside = there(backend, poses.copy(), index, discs.copy(), 1e-6 * poses, 1e-6 * discs)
    cast = caster.bind(placed, turn, world=where)

    def step() -> None:
        nonlocal placed, moved
        placed += ahead
        moved += beside
        worlds.shapes = gs.Shapes(discs=moved)
        cast()
        worlds.collides(placed, 0.2, world=where)

    def rates(measure: Callable[[], Any], step: Callable[[], Any], lidars: int) -> tuple[str, ...]:
        each = (least(backend, arguments.repeats, arguments.seconds, run)[0] for run in (measure, step))
        return str(lidars), *(f"{lidars / taken:.3g}" for taken in each)

    lines = []
    for name, program in (("vmas", vmas_program), ("irsim", ir_sim_program)):
        if importlib.util.find_spec(name) is None:
            note(f"{name} is not installed")
            continue
        measure, other_step, bearings = program(poses, discs, rays, longest)
        found = measure()
        off = np.abs(found - caster.cast(poses, bearings, world=index)[: len(found)])
        wrong = f"{np.quantile(off, 0.99):.1g} m (99 % of rays), {off.max():.1g} m"
        lines.append((name, *rates(measure, other_step, len(found)), wrong))
    return [(f"gpusense, {backend.info.selection}", *rates(cast, step, count), ""), *lines]


Program = tuple[Callable[[], np.ndarray], Callable[[], Any], np.ndarray]


def vmas_program(poses: np.ndarray, discs: np.ndarray, rays: int, longest: float) -> Program:
    """Return functions that measure VMAS's lidars and step its world, and the bearings of the beams [rad]."""
    import torch
    from vmas.simulator.core import Agent, Landmark, Sphere, World
    from vmas.simulator.sensors import Lidar

    world = World(batch_dim=len(poses), device="cpu")
    lidar = Lidar(world, n_rays=rays, max_range=longest)
    robot = Agent("robot", shape=Sphere(0.2), sensors=[lidar])
    world.add_agent(robot)
    for number in range(discs.shape[1]):
        disc = Landmark(f"disc {number}", collide=True, movable=True, shape=Sphere(discs[0, number, 2]))
        world.add_landmark(disc)
        disc.set_pos(torch.tensor(discs[:, number, :2], dtype=torch.float32), batch_index=None)
    robot.set_pos(torch.tensor(poses[:, :2], dtype=torch.float32), batch_index=None)
    robot.set_rot(torch.tensor(poses[:, 2:], dtype=torch.float32), batch_index=None)

    def step() -> Any:
        world.step()
        lidar.measure()
        return [world.is_overlapping(robot, disc) for disc in world.landmarks]

    return lambda: lidar.measure().numpy(), step, np.linspace(0, 2 * np.pi, rays, endpoint=False)


def ir_sim_program(poses: np.ndarray, discs: np.ndarray, rays: int, longest: float) -> Program:
    """Return functions that measure the lidars of ir-sim in 16 worlds and step these, and the bearings [rad]."""
    import irsim

    worlds = []
    for (x, y, theta), each in zip(poses[:16].tolist(), discs.tolist(), strict=False):
        circles = "\n".join(f"  - {{shape: {{name: circle, radius: {r}}}, state: [{u}, {v}, 0]}}" for u, v, r in each)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "scene.yaml")
            path.write_text(f"""
world: {{height: 40, width: 40, offset: [-20, -20]}}
robot:
  - {{kinematics: {{name: diff}}, shape: {{name: circle, radius: 0.2}}, state: [{x}, {y}, {theta}], sensors: [
     {{name: lidar2d, range_min: 0, range_max: {longest}, angle_range: {2 * np.pi}, number: {rays}}}]}}
obstacle:
{circles}
""")
            worlds.append(irsim.make(str(path), display=False, save_ani=False))
    robots = [world.robot_list[0] for world in worlds]

    def measure() -> np.ndarray:
        for robot in robots:
            robot.lidar.step(robot.state)
        return np.array([robot.lidar.range_data for robot in robots])

    return measure, lambda: [world.step(np.zeros((2, 1))) for world in worlds], robots[0].lidar.angle_list


def line_of(row: dict[str, Any]) -> list[str]:
    """Return the cells of a row."""
    text = "{worlds}|{shapes}|{rate:.0f} / {rates[0]:.0f}|{of_room[0]:.2f}|{rates[1]:.0f} / {rates[2]:.0f}|"
    text += "{of_room[1]:.2f} / {of_room[2]:.2f}|{made:.2f}|{replaced:.2f}|{bytes:.1f}|"
    return [*text.format(**row).split("|")[:-1], row["launches"]]


def main(argv: list[str] | None = None) -> None:
    """Measure, and write the results."""
    parser = make_parser(__doc__, backend="opencl", seed=False)
    parser.add_argument("--worlds", default="64,1024", help="numbers of worlds, with commas (default: 64,1024)")
    parser.add_argument("--shapes", type=int, default=0, help="moving shapes of each world (default: 0)")
    parser.add_argument("--kernels", action="store_true", help="measure each launch by the device's clock")
    parser.add_argument("--processor-time", action="store_true", help="for machines on which others work too")
    parser.add_argument("--peers", action="store_true", help="compare a lidar among discs with those of peers")
    add_repeats(parser, 20, 5.0)
    arguments = parse(parser, argv)
    if arguments.processor_time:
        globals()["clock"] = lambda: time.process_time() / processor.threads()
    if arguments.peers:
        lines = peers(arguments)
        columns = ("program", "lidars of 64 beams", "lidars/s", "steps/s", "differs from gpusense by at most")
        publish(__file__, arguments, table(columns, lines), {"rows": lines})
        return
    rows = measure(arguments)
    publish(__file__, arguments, table(COLUMNS.split("|"), map(line_of, rows)), {"rows": rows})


if __name__ == "__main__":
    main()
