"""Simulate a robot that drives through a world, with the readings of its laser and its odometer; write its log."""

from __future__ import annotations

import dataclasses
import functools
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks
from gpusense._util.typing import Flags, Floats
from gpusense.backends import Selection
from gpusense.evaluation.simulation.changes import change_world, make_glass
from gpusense.evaluation.simulation.crowd import Crowd
from gpusense.evaluation.simulation.roads import Roads, drive
from gpusense.evaluation.worlds import is_free, sample_readings
from gpusense.localization.motion import OdometryMotion, OmniMotion
from gpusense.logs.bag_writer import write_bag
from gpusense.logs.carmen import write_carmen
from gpusense.logs.records import Scan
from gpusense.models.arguments import check_absent
from gpusense.models.scan.beam import BeamModel
from gpusense.world.grid import OccupancyGrid
from gpusense.world.parameters import BeamParameters
from gpusense.world.pose_algebra import compose_poses
from gpusense.world.scanner import Scanner

Rng = np.random.Generator

READINGS = BeamParameters(z_hit=0.97, z_short=0.01, z_max=0.01, z_rand=0.01, sigma_hit=0.02, lambda_short=0.5)
# Largest distance between two scans [m]; a path between two places of a building must be longer now and then.
_FARTHEST_STEP = 100.0
# Per step about 5 % of the translation and of the turn, and 0.03 rad/m.
MOTION = OdometryMotion((0.0025, 0.001, 0.0025, 0.0001), reverse=0.0, least=(0.001, 0.001))
_SCANS = 200
# Rays of one call of the caster.
_RAYS = 1 << 20


@dataclass(frozen=True, eq=False)
class SimulatedRun:
    """A run of a robot: readings and truth.

    Attributes:
        grid: The map that the robot has.
        world: The true world, without people.
        scanner: The geometry of the laser.
        times: (T,) times of the scans [s].
        poses: (T, 3) true poses of the robot [m, m, rad].
        odometry: (T, 3) poses by odometry alone, the first one 0 [m, m, rad].
        scans: (T, K) readings [m], +inf where there is no return.
        expected: (T, K) ranges in the world with its people, before noise [m]; ``range_max`` where nothing is nearer.
        hidden: (T, K) whether a person hides what lies behind.
        kidnapped: (T,) whether the robot was carried to this pose.
        people: T arrays (P, 3) of people as discs: x, y and radius [m].
    """

    grid: OccupancyGrid
    world: OccupancyGrid
    scanner: Scanner
    times: Floats
    poses: Floats
    odometry: Floats
    scans: Floats
    expected: Floats
    hidden: Flags
    kidnapped: Flags
    people: tuple[Floats, ...]

    def __repr__(self) -> str:
        return f"SimulatedRun({len(self.times)} scans of {self.scanner.count} beams, {self.hidden.mean():.0%} hidden)"


def simulate_run(
    grid: OccupancyGrid,
    scanner: Scanner,
    *,
    scans: int | None = None,
    world: OccupancyGrid | None = None,
    path: ArrayLike | None = None,
    parameters: BeamParameters = READINGS,
    motion: OdometryMotion | OmniMotion = MOTION,
    people: int = 0,
    hidden: float = 0.0,
    moved: float = 0.0,
    removed: float = 0.0,
    added: float = 0.0,
    glass: float = 0.0,
    kidnaps: int = 0,
    step: float = 0.2,
    turn: float = 0.35,
    period: float = 0.25,
    clearance: float = 0.35,
    seed: int = 0,
    backend: Selection = "numpy",
) -> SimulatedRun:
    """Simulate a robot that drives between random places of a world.

    The robot keeps to cells that are free in the map and in the world. It turns on the spot at the corners of its path.
    A beam that meets nothing within ``range_max`` gives no return, apart from the shares of short and random readings;
    all other readings are drawn from the beam model around the range to the nearest wall or person.

    Args:
        grid: The map that the robot has.
        scanner: The geometry of its laser, mount and cones included.
        scans: Number of scans T, at least 1; None for 200 or, with ``path``, for all of its poses. With ``path`` a
            number takes its first poses.
        world: The true world; None for the map with the changes below. With a different building as world, ``grid`` is
            a wrong map, and the path is planned in the world alone.
        path: (T, 3) true poses of the robot instead of a planned path [m, m, rad].
        parameters: Mixture of the readings.
        motion: Noise of the odometry.
        people: Number of people who walk near the robot.
        hidden: Approximate share of the beams that additional people hide, from 0 to 0.9.
        moved: Share of the walls that are moved, as in :func:`change_world`.
        removed: Share of the walls that are removed.
        added: New furniture, as a share of the walls.
        glass: Share of the world's walls through which beams pass, from 0 to 1.
        kidnaps: Number of times that the robot is carried to another place, without odometry.
        step: Distance between two scans [m], > 0.
        turn: Largest turn between two scans [rad], > 0.
        period: Time between two scans [s], > 0.
        clearance: Least distance of the robot from walls on a planned path [m].
        seed: Seed of the random numbers; equal arguments give equal runs on every device.
        backend: Device that casts the beams; see ``gpusense.devices()``.

    Returns:
        The run.

    Raises:
        TypeError, ValueError: an argument has the wrong type or breaks its rule.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> scanner = gs.Scanner(np.linspace(-2.0, 2.0, 60), range_max=12.0)
        >>> run = gs.worlds.simulate_run(gs.worlds.building(), scanner, scans=20, hidden=0.1, moved=0.1, seed=1)
        >>> run.scans.shape, run.odometry.shape
        ((20, 60), (20, 3))
    """
    given = None if path is None else checks.array("path", path, ("T", 3))
    most = None if given is None else max(len(given), 1)
    count = (most or _SCANS) if scans is None else checks.integer("scans", scans, low=1, high=most)
    jumps = checks.integer("kidnaps", kidnaps, low=0, high=count - 1)
    crowd_size = checks.integer("people", people, low=0, high=1000)
    share = checks.real("hidden", hidden, low=0, high=0.9)
    every = checks.real("period", period, above=0)
    room = checks.real("clearance", clearance, low=0)
    rates = checks.real("step", step, above=0, high=_FARTHEST_STEP), checks.real("turn", turn, above=0)
    _check_kinds(grid, scanner, world, parameters, motion)
    # Each part has a separate random stream, so that people do not change the odometry.
    streams = np.random.SeedSequence(checks.integer("seed", seed, low=0)).spawn(6)
    changing, driving, slipping, walking, reading, glazing = (np.random.default_rng(one) for one in streams)
    true = world
    if true is not None:
        check_absent("with a world", moved=moved or None, removed=removed or None, added=added or None)
    else:
        keep = np.zeros((0, 3)) if given is None else given[:count]
        true = change_world(grid, changing, moved=moved, removed=removed, added=added, keep=keep, clearance=room)
    poses, kidnapped = (
        _planned(grid, true, world is None, count, jumps, room, rates, driving) if given is None
        else _given(given[:count], jumps)
    )  # fmt: skip
    odometry = draw_odometry(poses, motion, slipping, kidnapped)
    seen = _without_glass(true, glass, glazing)
    crowd = Crowd(crowd_size, share, functools.partial(is_free, true), every, walking)
    expected, covered, discs = _with_people(_cast(seen, scanner, poses, backend), scanner, poses, kidnapped, crowd)
    readings = _readings(expected, scanner.range_max, parameters, reading)
    times: Floats = every * np.arange(1, len(poses) + 1, dtype=np.float64)
    return SimulatedRun(
        grid, true, scanner, times, poses, odometry, readings, expected, covered, kidnapped, tuple(discs)
    )


def _check_kinds(grid: object, scanner: object, world: object, parameters: object, motion: object) -> None:
    """Refuse arguments of another type."""
    kinds: tuple[tuple[str, object, tuple[type, ...]], ...] = (
        ("grid", grid, (OccupancyGrid,)), ("scanner", scanner, (Scanner,)),
        ("world", grid if world is None else world, (OccupancyGrid,)), ("parameters", parameters, (BeamParameters,)),
        ("motion", motion, (OdometryMotion, OmniMotion)),
    )  # fmt: skip
    for name, value, kind in kinds:
        if not isinstance(value, kind):
            raise TypeError(f"{name}: must be {' or '.join(one.__name__ for one in kind)}, got {checks.show(value)}")


def _planned(
    grid: OccupancyGrid,
    world: OccupancyGrid,
    same: bool,
    count: int,
    jumps: int,
    clearance: float,
    rates: tuple[float, float],
    rng: Rng,
) -> tuple[Floats, Flags]:
    """Return true poses along planned paths, and whether the robot was carried to each."""
    roads = Roads(world, world.free & grid.free if same else world.free, clearance, rng)
    when = np.zeros(count, bool)
    when[rng.choice(np.arange(1, count), jumps, replace=False)] = True
    parts: list[Floats] = []
    begin = 0
    for end in (*np.flatnonzero(when).tolist(), count):
        pace = rng.uniform(0.6, 1.0)
        corners = roads.wander((end - begin) * rates[0] * pace, rng)
        heading = rng.uniform(-math.pi, math.pi)
        parts.append(np.array([[*corners[0], heading]]))
        parts.append(drive(corners, heading, rates[0] * pace, rates[1], end - begin - 1))
        begin = end
    return np.concatenate(parts), when


def _given(path: Floats, jumps: int) -> tuple[Floats, Flags]:
    """Return the poses of a path without kidnaps."""
    if not len(path):
        raise ValueError("path: must hold at least one pose, got shape (0, 3)")
    if jumps:
        raise ValueError(f"kidnaps: must be 0 with a path, got {jumps}")
    return path, np.zeros(len(path), bool)


def _without_glass(world: OccupancyGrid, share: float, rng: Rng) -> OccupancyGrid:
    """Return the world that beams see, without glass."""
    if checks.real("glass", share, low=0, high=1) == 0:
        return world
    cells = np.array(world.cells)
    cells[make_glass(world, share, rng)] = 0
    return OccupancyGrid(cells, world.resolution, world.origin, occupied_threshold=world.occupied_threshold)


def _cast(world: OccupancyGrid, scanner: Scanner, poses: Floats, backend: Selection) -> Floats:
    """Return the (T, K) ranges to walls in float32, with equal bits on every device."""
    model = BeamModel(world, scanner, BeamParameters(), backend=backend, precision="float32")
    each = max(_RAYS // max(scanner.ray_bearings.size, 1), 1)
    parts = [np.asarray(model.expected_ranges(poses[i : i + each])) for i in range(0, len(poses), each)]
    # The nearest float32 of range_max may exceed it.
    walls = np.concatenate(parts).astype(np.float64)
    return np.where(walls >= np.float32(scanner.range_max), scanner.range_max, np.minimum(walls, scanner.range_max))


def _with_people(
    walls: Floats, scanner: Scanner, poses: Floats, kidnapped: Flags, crowd: Crowd
) -> tuple[Floats, Flags, list[Floats]]:
    """Return ranges to the nearest wall or person, the beams that people hide, and the people's discs."""
    expected, hidden, discs = walls.copy(), np.zeros(walls.shape, bool), []
    lasers = compose_poses(poses, scanner.mount)
    for t, laser in enumerate(lasers):
        if kidnapped[t]:
            crowd.leave()
        expected[t], hidden[t] = crowd.ranges(laser, scanner.ray_bearings, walls[t])
        discs.append(crowd.discs())
    return expected, hidden, discs


def _readings(expected: Floats, range_max: float, parameters: BeamParameters, rng: Rng) -> Floats:
    """Draw readings; if nothing is within range, a hit becomes "no return"."""
    p = parameters
    nothing = p.replace(z_hit=0.0, z_max=p.z_hit + p.z_max)
    flat = expected.ravel()
    near = sample_readings(flat, range_max, p, rng)
    far = sample_readings(flat, range_max, nothing, rng)
    return np.where(flat >= range_max, far, near).reshape(expected.shape)


def draw_odometry(
    poses: Floats, motion: OdometryMotion | OmniMotion, rng: np.random.Generator, jumps: NDArray[np.bool]
) -> Floats:
    """Return the odometer's poses along true poses; the first one is 0.

    The deviations of the noise follow from the true motion. The odometer has the systematic errors that the model
    corrects.

    ``poses``: (T, 3) true poses. ``jumps``: (T,) whether the robot was carried to a pose, without motion of its
    odometer.
    """
    odometry = np.zeros_like(poses)
    systematic = motion.systematic if isinstance(motion, OdometryMotion) else (0.0, 0.0, 0.0)
    if isinstance(motion, OdometryMotion):
        motion = dataclasses.replace(motion, systematic=(0.0, 0.0, 0.0))
    noise, other = rng.standard_normal((len(poses), 4)), rng.random(len(poses))
    for t in range(1, len(poses)):
        if jumps[t]:
            odometry[t] = odometry[t - 1]
            continue
        step = motion.sampled(poses[t - 1], poses[t])
        first, ahead, left, second = (np.array(step.mean) + np.array(step.deviation) * noise[t]).tolist()
        if other[t] < step.reverse:
            ahead = -ahead
        stretch, gain, drift = systematic
        ahead = ahead / (1 + stretch)
        drifted = drift * ahead / 2
        first, second = (first - drifted) / (1 + gain), (second - drifted) / (1 + gain)
        odometry[t] = step._replace(mean=(first, ahead, left, second)).after(odometry[t - 1].tolist())
    return odometry


def write_run(run: SimulatedRun, path: str | os.PathLike[str], kind: str | None = None) -> None:
    """Write a simulated run as a log that ``read_log`` reads.

    Args:
        run: The run.
        path: The log.
        kind: ``"carmen"``, compressed if the name ends in ``.gz``, with true poses of the laser, since the format has
            no mount. ``"ros1"``, a bag of ROS 1 whose name ends in ``.bag``, or ``"ros2"``, the folder of a bag of ROS
            2, which must not exist: both have the mount, but no true poses. None takes ``"ros1"`` if the name ends in
            ``.bag``, and else ``"carmen"``.

    Raises:
        TypeError, ValueError: an argument has the wrong type, or the format cannot hold the scans.
        ImportError: the library rosbags is absent, and the log is a bag.
        OSError: the log cannot be written.

    Example:
        >>> import gpusense as gs, numpy as np, pathlib, tempfile
        >>> scanner = gs.Scanner(np.radians(np.arange(-90, 91)), range_max=12.0)
        >>> run = gs.worlds.simulate_run(gs.worlds.building(), scanner, scans=3)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     gs.worlds.write_run(run, log := pathlib.Path(folder, "run.log"))
        ...     len(list(gs.read_log(log)))
        3
    """
    checks.instance("run", run, SimulatedRun)
    file = checks.path("path", path)
    kind = kind_of(file) if kind is None else checks.choice("kind", kind, ("carmen", "ros1", "ros2"))
    if kind == "carmen":
        write_carmen(file, records_of(run, of_laser=True))
        return
    write_bag(file, records_of(run), first=kind == "ros1")


def kind_of(path: Path) -> str:
    """Return the format of a log by its name."""
    suffix = path.suffix.lower()
    if suffix in (".db3", ".mcap"):
        rule = "must not end in .db3 or .mcap; a bag of ROS 2 is a folder, format ros2"
        raise ValueError(f"{path}: {rule}, got {suffix!r}")
    return "ros1" if suffix == ".bag" else "carmen"


def records_of(run: SimulatedRun, *, of_laser: bool = False) -> Iterator[Scan]:
    """Yield the scans of a run as records of a log, with true poses."""
    scanner, poses, odometry = run.scanner, run.poses, run.odometry
    if of_laser and any(scanner.mount):
        poses, odometry = (compose_poses(one, scanner.mount) for one in (poses, odometry))
        scanner = Scanner(
            scanner.bearings, scanner.range_max, scanner.range_min, cone=scanner.cone, cone_rays=scanner.cone_rays,
            critical_incidence=scanner.critical_incidence,
        )  # fmt: skip
    for time, ranges, *pair in zip(run.times.tolist(), run.scans, odometry.tolist(), poses.tolist(), strict=True):
        readings = np.array(ranges)
        readings.setflags(write=False)
        odometer, pose = ((x, y, theta) for x, y, theta in pair)
        yield Scan(time, readings, scanner, odometer, pose)
