"""Compute a robot's trajectory from its scans and optional odometry: matches, loops, and their pose graph."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.typing import Floats, Precision
from gpusense.backends import Selection, get_backend
from gpusense.chaining.closing import Loops
from gpusense.chaining.drift import pose_covariances
from gpusense.chaining.front import LOCAL, Front
from gpusense.chaining.graph import Solution, solve
from gpusense.chaining.joint import (
    TEMPERATURE,
    Joint,
    constant_motion_links,
    fitted_odometry,
    links_of_odometry,
    weighed,
)
from gpusense.chaining.links import CLOSURE, Links, relative
from gpusense.chaining.matcher import (
    ChainOptions,
    Matcher,
    TeamMatcher,
    check_durations,
    check_step,
    check_times,
    signed_duration,
)
from gpusense.chaining.place_recognition import place_points_of
from gpusense.chaining.result import ScanChain, doubts_of
from gpusense.localization.motion import OdometryMotion
from gpusense.matching.match import readings
from gpusense.models.arguments import real_dtype
from gpusense.world.pose_algebra import compose_poses, pose_difference, rotations
from gpusense.world.scanner import Scanner
from gpusense.world.sensor_scans import check_scans


def chain_scans(
    scans: ArrayLike,
    scanner: Scanner | Sequence[Scanner],
    odometry: ArrayLike | None = None,
    *,
    sensor: ArrayLike | None = None,
    times: ArrayLike | None = None,
    duration: float | Sequence[float] = 0.0,
    motion: OdometryMotion | None = None,
    step: ArrayLike = (0.02, 0.01),
    close_loops: bool = True,
    precision: Precision = "float32",
    backend: Selection = "auto",
) -> ScanChain:
    """Compute the trajectory of a robot from its scans and, if available, its odometry.

    Each scan is matched to the previous scan, and to key scans around it (:func:`gpusense.match_scan`). Matches start
    from the odometry's motion, or else from rest and from their neighbours' motion. Revisited places are searched for
    within the expected drift; sure closures that agree with each other are accepted. The poses are the least-squares
    solution with a robust kernel over all links. Odometry, with noise fitted to the matches, or else constant motion
    fills directions that scans do not observe.

    Scans are matched to scans of the same scanner; loops also match scanners of equal bearings, such as front and
    rear. A key scan is coupled with the scans of the other scanners before and after it.

    Args:
        scans: (S, K) readings in the order of time [m], at least one; for several scanners, S readings of each
            scanner's length.
        scanner: The scanner, or several; the mount is the sensor's pose on the robot.
        odometry: (S, 3) poses of the odometer at the scans [m, m, rad]. None: no odometry.
        sensor: (S,) index of the scanner of each scan; only for several scanners.
        times: (S,) times of the first beams [s]. None: unknown.
        duration: Time from the first beam of a scan to the last one [s], to correct scans for the robot's motion; needs
            ``times``. Beams are measured at equal intervals in order, in reverse, or all at once; the order with the
            best agreement of scans is used. 0: at once. For several scanners optionally a number each.
        motion: Noise of the odometry. None: fitted to the matches.
        step: Least motion by odometry of a matched scan [m, rad]; other scans cost nothing.
        close_loops: Whether to search for revisited places.
        precision: Precision of the matches, ``"float32"`` or ``"float64"``.
        backend: The device, see :func:`gpusense.devices`.

    Returns:
        Poses, covariances, links, closures and doubts.

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
        scans, scanner, odometry, sensor=sensor, times=times, duration=duration, motion=motion, step=step,
        close_loops=close_loops, precision=precision, backend=backend,
    )  # fmt: skip
    for _ in chainer.steps():
        pass
    return chainer.chain()


class Chainer:
    """Incremental :func:`chain_scans`; the trajectory so far can be read after each step."""

    def __init__(
        self,
        scans: ArrayLike,
        scanner: Scanner | Sequence[Scanner],
        odometry: ArrayLike | None,
        *,
        sensor: ArrayLike | None = None,
        times: ArrayLike | None = None,
        duration: float | Sequence[float] = 0.0,
        motion: OdometryMotion | None = None,
        step: ArrayLike = (0.02, 0.01),
        close_loops: bool = True,
        precision: Precision = "float32",
        backend: Selection = "auto",
    ) -> None:
        device = get_backend(backend)
        real_dtype(precision, device)
        self._data = data = check_scans(scans, scanner, sensor, partial(readings, backend=device))
        if not len(data):
            raise ValueError("scans: must hold at least one scan, got none")
        self._odometry = (
            None if odometry is None else checks.array("odometry", odometry, (len(data), 3), largest=checks.FARTHEST)
        )
        self._times = check_times(times, len(data))
        self._durations = list(check_durations(duration, len(data.scanners), self._times is not None))
        if motion is not None and not isinstance(motion, OdometryMotion):
            raise TypeError(f"motion: must be an OdometryMotion, got {checks.show(motion)}")
        checks.boolean("close_loops", close_loops)
        self._options = ChainOptions(
            check_step(step), 0.0, motion, close_loops, backend, precision,
        )  # fmt: skip
        self._fronts = [self._new_front(one) for one in range(len(data.scanners))]
        # The trajectory with its links, and the search for loops in it, once it has begun.
        self._loops: tuple[Joint, Links, Loops] | None = None
        self._motion = motion

    @property
    def scans(self) -> int:
        """Number of scans chained so far."""
        ends = [
            int(rows[front.nodes[front.done - 1]]) + 1
            for front, rows in zip(self._fronts, self._data.rows, strict=True)
            if front.done < len(front.nodes)
        ]
        return min(ends, default=len(self._data))

    @property
    def fronts(self) -> tuple[Front, ...]:
        """The front end of each scanner."""
        return tuple(self._fronts)

    @property
    def loops(self) -> Loops | None:
        """The search for revisited places; None before it begins."""
        return None if self._loops is None else self._loops[2]

    def steps(self) -> Iterator[str]:
        """Match, search and close loops step by step, and yield a message on each step."""
        for one, duration in enumerate(self._durations):
            if duration > 0 and self._fronts[one].done == 1:
                yield from self._find_order(one)
        # Advance the front end that is farthest behind.
        while waiting := [
            (int(rows[front.nodes[front.done]]), one)
            for one, (front, rows) in enumerate(zip(self._fronts, self._data.rows, strict=True))
            if front.done < len(front.nodes)
        ]:
            self._fronts[min(waiting)[1]].advance()
            yield f"scan {self.scans} of {len(self._data)}"
        if self._options.close_loops and any(len(front.keys) > LOCAL + 1 for front in self._fronts):
            joint = self._joint()
            links = self._links(joint)
            self._loops = joint, links, self._make_loops(joint, links)
            yield from self._loops[2].steps()

    def _find_order(self, one: int) -> Iterator[str]:
        """Determine the order of a scanner's beams in time, and restart its front end with this order."""
        assert self._times is not None
        data, duration = self._data, self._durations[one]
        matcher = Matcher(data.readings[one], data.scanners[one], self._options)
        found = signed_duration(matcher, self._times[data.rows[one]], duration)
        if found != duration:
            self._durations[one] = found
            self._fronts[one] = self._new_front(one)
            of = f" of scanner {one}" if len(data.scanners) > 1 else ""
            yield f"beams{of} are measured in reverse order" if found < 0 else f"beams{of} are measured all at once"

    def _new_front(self, one: int) -> Front:
        """Return the front end of a scanner before its first scan."""
        rows = self._data.rows[one]
        odometry, times = (None if values is None else values[rows] for values in (self._odometry, self._times))
        options = replace(self._options, duration=self._durations[one])
        return Front(self._data.readings[one], self._data.scanners[one], odometry, times, options)

    def _joint(self) -> Joint:
        """Return the matched scans so far as one trajectory."""
        times = self._times
        if times is not None:
            times = times + np.maximum(-np.array(self._durations), 0.0)[self._data.sensor]
        return Joint(self._fronts, self._data.rows, times, self.scans)

    def chain(self) -> ScanChain:
        """Return the trajectory of the scans so far."""
        if self._loops is None:
            joint = self._joint()
            links, poses, closures = self._links(joint), joint.poses, Links.joined([])
        else:
            joint, links, loops = self._loops
            closures = loops.closures.renumbered(joint.keys)
            # All poses move with their preceding key scans.
            key = np.searchsorted(joint.keys, np.arange(len(joint.poses)), "right") - 1
            moved = pose_difference(joint.poses[joint.keys[key]], joint.poses)
            poses = compose_poses(loops.solution.poses[key], moved)
        # The curvature of a long chain is barely observable without closures, and the chain of matches bends least.
        solution = solve(poses, Links.joined([links, closures]), settle=len(closures) > 0)
        spread = pose_covariances(solution)
        found = solution.links.kind == CLOSURE
        moved = relative(joint.poses, solution.links.first[found], solution.links.second[found])
        corrections = np.hypot(*(solution.links.pose[found] - moved)[:, :2].T)
        return self._placed(joint, solution, spread, corrections)

    def _make_loops(self, joint: Joint, links: Links) -> Loops:
        """Return the search for loops in the graph of the key scans."""
        keys, data = joint.keys, self._data
        number = np.full(len(joint.nodes), -1)
        number[keys] = np.arange(len(keys))
        poses = joint.poses if len(joint.fronts) == 1 else solve(joint.poses, links).poses
        links = links[(number[links.first] >= 0) & (number[links.second] >= 0)].renumbered(number)
        links = Links.joined([links, joint.couplings_of_keys(poses)])
        places = data.places()
        matcher = TeamMatcher([front.matcher for front in joint.fronts], data.sensor, places)
        nodes, weak = joint.nodes[keys], np.append(0, np.cumsum(joint.weak))
        return Loops(
            matcher, nodes, (joint.owner[keys], joint.ranks()), place_points_of(data, nodes), joint.broken[keys],
            weak[keys], links, solve(poses[keys], links), TEMPERATURE, (LOCAL + 1) * len(joint.fronts),
        )  # fmt: skip

    def _links(self, joint: Joint) -> Links:
        """Return the links of matches and of odometry or constant motion; fit the odometry's noise."""
        parts = [joint.renumbered(weighed(front), one) for one, front in enumerate(joint.fronts)]
        if self._odometry is None:
            links = Links.joined([*parts, joint.couplings(None, None)])
            jumped = joint.jumped() & joint.failed
            return Links.joined([links, constant_motion_links(joint.poses, joint.keys, jumped, links)])
        for one, front in enumerate(joint.fronts):
            links, wheels = weighed(front), self._odometry[self._data.rows[one][front.nodes[: front.done]]]
            if front.done < 2:
                continue
            if self._options.motion is None and one == 0:
                self._motion = fitted_odometry(front, links, wheels)
            others = links_of_odometry(front, links, wheels, self._motion or OdometryMotion())
            # All scanners share one odometer.
            others = replace(others, information=others.information / len(joint.fronts))
            parts.append(joint.renumbered(others, one))
        return Links.joined([*parts, joint.couplings(self._odometry[joint.nodes], self._motion)])

    def _placed(self, joint: Joint, solution: Solution, spread: Floats, corrections: Floats) -> ScanChain:
        """Return the result for all scans so far; scans that are no nodes take the last node's pose."""
        count, nodes = self.scans, joint.nodes
        node = np.searchsorted(nodes, np.arange(count), "right") - 1
        poses, covariance = solution.poses[node], spread[node]
        start = np.zeros(3)
        if self._odometry is not None:
            start = self._odometry[0]
            moved = pose_difference(self._odometry[nodes[node]], self._odometry[:count])
            poses = compose_poses(poses, moved)
        turn = rotations(start[2])
        durations = tuple(self._durations)
        return ScanChain(
            compose_poses(start, poses), turn @ covariance @ turn.T, solution.links.renumbered(nodes),
            nodes[joint.keys], None if self._odometry is None else self._motion, self._motions(count),
            durations[0] if len(durations) == 1 else durations, self._data.sensor[:count], corrections,
            doubts_of(joint, self._odometry is None), len(nodes), 0 if self.loops is None else self.loops.searched,
        )  # fmt: skip

    def _motions(self, count: int) -> Floats | None:
        """Return the motions during the scans so far; None for instantaneous scans."""
        if all(front.matcher.motion is None for front in self._fronts):
            return None
        motions = np.zeros((len(self._data), 3))
        for front, rows in zip(self._fronts, self._data.rows, strict=True):
            if front.matcher.motion is not None:
                last = np.searchsorted(front.nodes[: front.done], np.arange(len(rows)), "right") - 1
                motions[rows] = front.matcher.motion[front.nodes[last]]
        return motions[:count]
