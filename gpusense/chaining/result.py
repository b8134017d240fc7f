"""Result of a chain of scans: trajectory, links, closures and doubts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpusense._util.typing import Floats, Integers
from gpusense.chaining.joint import Joint
from gpusense.chaining.links import CLOSURE, Links, runs_of
from gpusense.localization.motion import OdometryMotion

REASONS = {
    "no match": "the scan matches neither its predecessor nor key scans: its motion is from odometry or a guess",
    "unobserved": "the scans do not observe a direction of the motion, as along a corridor, and there is no odometry",
    "contested": "the scans agree about as well for a second motion, and there is no odometry to decide between both",
    "unconfirmed": "an unsure match, or without odometry a single one, determines the motion: nothing confirms it",
    "jump": "the time jumps, and the robot may be anywhere after it",
}
"""Meaning of each doubt."""


class Doubt(NamedTuple):
    """Doubtful stretch of the trajectory."""

    first: int  # index of the scan before the first doubtful motion
    last: int  # index of the scan after the last doubtful motion
    reason: str  # one of :data:`gpusense.chaining.result.REASONS`


@dataclass(frozen=True, eq=False)
class ScanChain:
    """Trajectory of S scans, from :func:`gpusense.chain_scans`.

    Attributes:
        poses: (S, 3) poses of the robot at the first listed beam of each scan [m, m, rad]; the first comes from the
            odometry, or is (0, 0, 0).
        covariance: (S, 3, 3) covariances given the first pose [m^2, m rad, rad^2]; very large along undetermined
            directions.
        links: Links of the pose graph between scans, including closures, with their weights in the solution.
        keys: (K,) indices of the key scans.
        motion: Noise of the odometry, passed or fitted to the matches; None without odometry.
        motions: (S, 3) motion of the robot from the first listed beam of each scan to the last one, or None if scans
            are instantaneous.
        duration: Used time from the first listed beam to the last one [s]; negative for beams in reverse order: see
            :attr:`later`. A tuple for several scanners.
        sensor: (S,) index of the scanner of each scan.
        corrections: (C,) distances [m] that closures moved second scans in the frames of first scans.
        doubts: Doubtful stretches.
        matched: Number of matched scans; at all others the robot stood still by its odometry.
        searched: Number of matched pairs of key scans in the search for revisited places.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> scanner = gs.Scanner.uniform(angle_min=-3.1, angle_increment=0.0175, count=356, range_max=9.0)
        >>> c, s = np.cos(scanner.bearings), np.sin(scanner.bearings)
        >>> room = [np.minimum((3 * np.sign(c) - x) / c, 2 / np.abs(s)) for x in (0.0, 0.1, 0.2)]
        >>> chain = gs.chain_scans(room, scanner, backend="numpy")
        >>> len(chain.closures), len(chain.doubts)
        (0, 0)
    """

    poses: Floats
    covariance: Floats
    links: Links
    keys: Integers
    motion: OdometryMotion | None
    motions: Floats | None
    duration: float | tuple[float, ...]
    sensor: Integers
    corrections: Floats
    doubts: tuple[Doubt, ...]
    matched: int
    searched: int

    @property
    def closures(self) -> Links:
        """The links that close loops."""
        return self.links[self.links.kind == CLOSURE]

    @property
    def doubtful(self) -> NDArray[np.bool]:
        """(S,) whether the motion to a scan is part of a doubtful stretch."""
        result = np.zeros(len(self.poses), bool)
        for doubt in self.doubts:
            result[doubt.first + 1 : doubt.last + 1] = True
        return result

    @property
    def later(self) -> Floats:
        """Time [s] from each scan to its pose, (S,): the scan's duration for beams in reverse order, else 0."""
        result: Floats = np.maximum(-np.atleast_1d(np.array(self.duration, np.float64)), 0.0)[self.sensor]
        return result

    def explain(self) -> str:
        """Describe the numbers of scans, key scans, links and closures, and the doubts, in words."""
        count = len(self.poses)
        lines = [f"{count} scans, {self.matched} matched, {len(self.keys)} key scans, {len(self.links)} links"]
        durations = self.duration if isinstance(self.duration, tuple) else (self.duration,)
        for k, duration in enumerate(durations):
            order = "in reverse" if duration < 0 else "in their order"
            of = f"scanner {k}: " if len(durations) > 1 else ""
            if duration:
                lines.append(
                    f"{of}scans of {abs(duration):.3g} s, measured {order}, are corrected for the robot's motion"
                )
        if len(self.corrections):
            lines.append(
                f"{len(self.corrections)} closures, which moved scans by {np.median(self.corrections):.2f} m in the "
                f"median and {self.corrections.max():.2f} m at most"
            )
        else:
            lines.append("no place was seen again with certainty: no loop is closed")
        for reason, meaning in REASONS.items():
            some = [doubt for doubt in self.doubts if doubt.reason == reason]
            if some:
                spans = ", ".join(f"{doubt.first} to {doubt.last}" for doubt in some[:10])
                more = f" and {len(some) - 10} more" if len(some) > 10 else ""
                lines.append(f"doubtful, scans {spans}{more}: {meaning}")
        return "\n".join(lines)

    def __repr__(self) -> str:
        return f"ScanChain({len(self.poses)} scans, {len(self.keys)} key scans, {len(self.corrections)} closures)"


def doubts_of(joint: Joint, alone: bool) -> tuple[Doubt, ...]:
    """Return the doubtful stretches."""
    failed, open_, nodes = joint.failed, joint.open & alone, joint.nodes
    contested = joint.contested & ~failed & ~open_
    single = (joint.confirmations() == 0) & alone | joint.weak
    single &= ~failed & ~open_ & ~contested & (len(nodes) > 2)
    reasons = {
        "no match": failed, "unobserved": open_, "contested": contested, "unconfirmed": single,
        "jump": joint.jumped() & failed,
    }  # fmt: skip
    doubts = []
    for reason, flags in reasons.items():
        first, last = (nodes[place].tolist() for place in runs_of(flags))
        doubts += [Doubt(*ends, reason) for ends in zip(first, last, strict=True)]
    return tuple(sorted(doubts))
