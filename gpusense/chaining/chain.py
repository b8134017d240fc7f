"""The trajectory of a robot from its scans alone, or with its odometry: matches, loops, and their pose graph."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks
from gpusense._util.typing import Precision
from gpusense.backends import Selection, get_backend
from gpusense.chaining.assembly import TEMPERATURE, constant_motion_links, fitted_odometry, links_of_odometry, weighed
from gpusense.chaining.closing import Loops
from gpusense.chaining.front import LOCAL, SURE, Front, Matcher
from gpusense.chaining.graph import Solution, solve
from gpusense.chaining.links import CLOSURE, Links
from gpusense.chaining.motion import relative
from gpusense.chaining.options import ChainOptions, check_steps, check_times, jumps_of
from gpusense.chaining.places import place_points
from gpusense.chaining.result import Doubt, ScanChain
from gpusense.chaining.selected import pose_covariances
from gpusense.chaining.sweep import signed_duration
from gpusense.localization.motion import OdometryMotion
from gpusense.localization.pose_algebra import compose_poses, pose_difference
from gpusense.matching.match import readings
from gpusense.matching.points import scan_points
from gpusense.models.arguments import real_dtype
from gpusense.world.scanner import Scanner

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


def chain_scans(
    scans: ArrayLike,
    scanner: Scanner,
    odometry: ArrayLike | None = None,
    *,
    times: ArrayLike | None = None,
    duration: float = 0.0,
    motion: OdometryMotion | None = None,
    step: ArrayLike = (0.02, 0.01),
    key_step: ArrayLike = (0.5, 0.35),
    close_loops: bool = True,
    precision: Precision = "float32",
    backend: Selection = "auto",
) -> ScanChain:
    """Return the trajectory of a robot from its scans, and its odometry where there is any.

    Each scan is matched to the one before, and to key scans around it (:func:`gpusense.match_scan`). Matches begin at
    the odometry's motion, or at none and at that of their neighbours. Places that are seen again are searched for
    within the expected drift; closures are taken where they are sure and agree with one another. The poses are those of
    least squares with a robust kernel over all links; the odometry, with noise fitted to the matches, fills the
    directions that scans do not observe, and constant motion does so without one.

    Args:
        scans: (S, K) readings in the order of time [m], at least one.
        scanner: Their scanner; its mount is the sensor's pose on the robot.
        odometry: (S, 3) poses of the odometer at the scans [m, m, rad]. None: there is none.
        times: (S,) times of the first beams [s]. None: unknown.
        duration: Time from the first beam of a scan to the last one [s], with which scans are freed of the robot's
            motion; needs ``times``. Beams are measured evenly in time, in their order, in reverse or at once: that
            with which scans agree best. 0: at once.
        motion: Noise of the odometry. None: fitted to the matches.
        step: Motion by odometry below which a scan is not matched [m, rad]: such scans cost nothing.
        key_step: Motion after which a scan becomes a key scan [m, rad].
        close_loops: Whether places that are seen again are searched for.
        precision: Of the matches, ``"float32"`` or ``"float64"``.
        backend: The device, see :func:`gpusense.devices`.

    Returns:
        Poses, covariances, links, closures, and what is doubtful.

    Raises:
        TypeError, ValueError: an argument is of the wrong kind or breaks its rule; the message names it.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> scanner = gs.Scanner.uniform(angle_min=-3.1, angle_increment=0.0175, count=356, range_max=9.0)
        >>> c, s = np.cos(scanner.bearings), np.sin(scanner.bearings)
        >>> room = [np.minimum((3 * np.sign(c) - x) / c, 2 / np.abs(s)) for x in (0.0, 0.1, 0.2)]
        >>> gs.chain_scans(room, scanner, backend="numpy").poses[:, 0].round(3).tolist()
        [0.0, 0.1, 0.2]
    """
    chainer = Chainer(
        scans, scanner, odometry, times=times, duration=duration, motion=motion, step=step, key_step=key_step,
        close_loops=close_loops, precision=precision, backend=backend,
    )  # fmt: skip
    for _ in chainer.steps():
        pass
    return chainer.chain()


class Chainer:
    """Chains scans in steps, after each of which the trajectory so far can be read; see :func:`chain_scans`."""

    def __init__(
        self,
        scans: ArrayLike,
        scanner: Scanner,
        odometry: ArrayLike | None,
        *,
        times: ArrayLike | None = None,
        duration: float = 0.0,
        motion: OdometryMotion | None = None,
        step: ArrayLike = (0.02, 0.01),
        key_step: ArrayLike = (0.5, 0.35),
        close_loops: bool = True,
        precision: Precision = "float32",
        backend: Selection = "auto",
    ) -> None:
        if not isinstance(scanner, Scanner):
            raise TypeError(f"scanner: must be a Scanner, got {checks.show(scanner)}")
        device = get_backend(backend)
        real_dtype(precision, device)
        read = np.atleast_2d(
            readings("scans", np.asarray(scans) if isinstance(scans, list) else scans, scanner, device)
        )
        if not len(read):
            raise ValueError("scans: must hold at least one scan, got none")
        self._odometry = None if odometry is None else checks.array("odometry", odometry, (len(read), 3))
        self._times = check_times(times, len(read))
        checks.real("duration", duration, low=0.0)
        if duration > 0 and self._times is None:
            raise ValueError(f"duration: must be 0 without times, got {duration}")
        if motion is not None and not isinstance(motion, OdometryMotion):
            raise TypeError(f"motion: must be an OdometryMotion, got {checks.show(motion)}")
        checks.boolean("close_loops", close_loops)
        self._options = ChainOptions(
            check_steps("step", step), check_steps("key_step", key_step), float(duration), motion, close_loops,
            backend, precision,
        )  # fmt: skip
        self._readings, self._scanner = read, scanner
        self._jumps = jumps_of(self._times, len(read))
        self._front = self._new_front()
        self._loops: Loops | None = None
        self._motion, self._fitted_to = motion, 0

    @property
    def scans(self) -> int:
        """Number of scans that are chained so far."""
        done, nodes = self._front.done, self._front.nodes
        return len(self._readings) if done == len(nodes) else int(nodes[done - 1]) + 1

    def steps(self) -> Iterator[str]:
        """Match, search and close, a part at a time, and yield a word on each."""
        if self._options.duration > 0 and self._front.done == 1:
            yield from self._find_order()
        while self._front.advance():
            yield f"scan {self.scans} of {len(self._readings)}"
        if self._options.close_loops and len(self._front.keys) > LOCAL + 1:
            self._loops = self._make_loops()
            yield from self._loops.steps()

    def _find_order(self) -> Iterator[str]:
        """Find the order in which beams are measured, and begin with it."""
        assert self._times is not None
        found = signed_duration(
            Matcher(self._readings, self._scanner, replace(self._options, duration=0.0)), self._times,
            self._options.duration,
        )  # fmt: skip
        if found != self._options.duration:
            self._options = replace(self._options, duration=found)
            self._front = self._new_front()
            yield "beams are measured in reverse order" if found < 0 else "beams are measured all at once"

    def _new_front(self) -> Front:
        """Return the front end before its first scan."""
        return Front(self._readings, self._scanner, self._odometry, self._times, self._jumps, self._options)

    def chain(self) -> ScanChain:
        """Return the trajectory of the scans so far."""
        front = self._front
        nodes = front.nodes[: front.done]
        links, poses = self._all_links(), front.poses
        closures = Links.joined([])
        if self._loops is not None:
            keys = np.array(front.keys)
            closures = self._loops.closures.renumbered(keys)
            poses = _carried(poses, keys, self._loops.solution.poses)
        solution = solve(poses, Links.joined([links, closures]))
        spread = pose_covariances(solution)
        found = solution.links.kind == CLOSURE
        moved = relative(front.poses, solution.links.first[found], solution.links.second[found])
        corrections = np.hypot(*(solution.links.pose[found] - moved)[:, :2].T)
        return self._placed(solution, spread, nodes, corrections)

    def _make_loops(self) -> Loops:
        """Return the search for loops in the graph of the key scans."""
        front = self._front
        keys = np.array(front.keys)
        number = np.full(front.done, -1)
        number[keys] = np.arange(len(keys))
        links = self._all_links()
        links = links[(number[links.first] >= 0) & (number[links.second] >= 0)].renumbered(number)
        points = scan_points(self._readings[front.nodes[keys]], self._scanner, np.dtype(np.float32))
        places = [place_points(points, self._scanner.mount[:2], k) for k in range(len(keys))]
        broken = np.append(0, np.cumsum(front.p_right < SURE))[keys]
        return Loops(
            front.matcher, front.nodes[keys], places, broken, links, solve(front.poses[keys], links), TEMPERATURE,
            LOCAL + 1,
        )  # fmt: skip

    def _all_links(self) -> Links:
        """Return the links of matches and of odometry or constant motion; the odometry's noise is fitted once."""
        front = self._front
        links = weighed(front)
        if front.done < 2:
            return links
        if self._odometry is None:
            return Links.joined([links, constant_motion_links(front, links, self._jumps)])
        reported = self._odometry[front.nodes[: front.done]]
        if self._options.motion is None and self._fitted_to != front.done:
            self._motion, self._fitted_to = fitted_odometry(front, links, reported), front.done
        assert self._motion is not None
        return Links.joined([links, links_of_odometry(front, links, reported, self._motion)])

    def _placed(self, solution: Solution, spread: Floats, nodes: Integers, corrections: Floats) -> ScanChain:
        """Return the result for all scans so far: those that are no nodes stand where the last node does."""
        front, count = self._front, self.scans
        node = np.searchsorted(nodes, np.arange(count), "right") - 1
        poses, covariance = solution.poses[node], spread[node]
        start = np.zeros(3)
        if self._odometry is not None:
            start = self._odometry[0]
            moved = pose_difference(self._odometry[nodes[node]], self._odometry[:count])
            poses = compose_poses(poses, moved)
        c, s = np.cos(start[2]), np.sin(start[2])
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        during = front.matcher.motion
        return ScanChain(
            compose_poses(start, poses), turn @ covariance @ turn.T, solution.links.renumbered(nodes),
            nodes[np.array(front.keys)], None if self._odometry is None else self._motion,
            None if during is None else during[nodes[node]], self._options.duration, corrections,
            self._doubts(nodes), len(nodes),
        )  # fmt: skip

    def _doubts(self, nodes: Integers) -> tuple[Doubt, ...]:
        """Return the stretches that are doubtful."""
        front = self._front
        failed = front.p_right < SURE
        jumped = self._jumps[nodes[1:]] & failed
        alone = self._odometry is None
        open_ = (front.lost > 0) & ~failed & alone
        single = (front.confirmations() == 0) & ~failed & ~open_ & alone & (len(nodes) > 2)
        doubts = []
        reasons = {"no match": failed, "unobserved": open_, "unconfirmed": single, "jump": jumped}
        for reason, flags in reasons.items():
            edges = np.diff(np.concatenate([[False], flags, [False]]).astype(int))
            for begin, end in zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True):
                doubts.append(Doubt(int(nodes[begin]), int(nodes[end]), reason))
        return tuple(sorted(doubts))


def _carried(poses: Floats, keys: Integers, placed: Floats) -> Floats:
    """Return poses moved with the key scans before them.

    Args:
        poses: (N, 3) poses.
        keys: (K,) indices of key scans, the first one 0.
        placed: (K, 3) new poses of these.
    """
    place = np.searchsorted(keys, np.arange(len(poses)), "right") - 1
    return compose_poses(placed[place], pose_difference(poses[keys[place]], poses))
