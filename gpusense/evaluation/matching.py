"""Match the scans of a recorded log with each other or with a map, and compare with the logged poses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense._util.angles import wrapped
from gpusense._util.typing import Floats
from gpusense.backends import Selection
from gpusense.logs import Scan
from gpusense.matching.match import Method, match_scan
from gpusense.matching.result import ScanMatch
from gpusense.world.grid import OccupancyGrid
from gpusense.world.pose_algebra import compose_poses

# Matches per call; a run can be interrupted between calls, and keeps the results so far.
_BATCH = 50
# Largest errors of a right match [m, rad].
WRONG, WRONG_TURN = 0.2, math.radians(5.0)


@dataclass(frozen=True)
class LogMatches:
    """Matches of a log.

    Attributes:
        indices: (S, 2) indices of the reference scan, -1 for a map, and of the second scan.
        logged: (S, 3) logged poses in the frame of the matches; NaN if the log has none.
    """

    indices: NDArray[np.int64]
    guess: Floats
    match: ScanMatch
    logged: Floats

    @property
    def errors(self) -> tuple[Floats, Floats]:
        """(S,) distances [m] and angles [rad] between matches and logged poses."""
        return differences(self.match.pose, self.logged)

    @property
    def wrong(self) -> NDArray[np.bool]:
        """(S,) whether an error is beyond 0.2 m or 5 degrees."""
        distance, turn = self.errors
        return (distance > WRONG) | (turn > WRONG_TURN)


def differences(poses: Floats, others: Floats) -> tuple[Floats, Floats]:
    """Return distances [m] and angles [rad] between (S, 3) poses."""
    off = poses - others
    return np.hypot(off[:, 0], off[:, 1]), np.abs(wrapped(off[:, 2]))


def relative_poses(first: Floats, second: Floats) -> Floats:
    """Return (S, 3) second poses in the frames of first ones; NaN where one is unknown."""
    c, s, off = np.cos(first[:, 2]), np.sin(first[:, 2]), second - first
    turn = wrapped(off[:, 2])
    return np.stack([c * off[:, 0] + s * off[:, 1], -s * off[:, 0] + c * off[:, 1], turn], axis=1)


def match_log(
    scans: list[tuple[int, Scan]],
    grid: OccupancyGrid | None,
    *,
    guess: str,
    method: Method,
    backend: Selection,
    spread: tuple[float, float],
    seed: int,
    noise: float | None = None,
) -> Iterator[LogMatches]:
    """Match each scan of a log to its predecessor, or all scans to a map; yield the matches of each call.

    ``grid``: The map, or None. ``guess``: ``"odometry"``, ``"logged"`` or ``"identity"``; a map needs ``"logged"``.
    ``spread``: Largest change of a guess in x and in y [m] and in heading [rad], uniformly at random. ``noise``:
    Standard deviation of ranges [m]; None for the default of ``match_scan``.
    """
    if grid is not None and guess != "logged":
        raise ValueError(f"--guess: must be 'logged' with --map, since odometry has another frame, got {guess!r}")
    if grid is None and len(scans) < 2:
        raise ValueError(f"log: must have two scans to match, got {len(scans)}")
    numbers = np.array([index for index, _ in scans])
    poses = np.array([scan.pose if scan.pose is not None else (math.nan,) * 3 for _, scan in scans])
    ranges = np.stack([scan.ranges for _, scan in scans])
    scanner = scans[0][1].scanner
    if grid is None:
        odometry = np.array([scan.odometry for _, scan in scans])
        logged = relative_poses(poses[:-1], poses[1:])
        guesses = {
            "odometry": relative_poses(odometry[:-1], odometry[1:]),
            "logged": logged,
            "identity": 0 * odometry[1:],
        }
        start, indices, second = guesses[guess], np.stack([numbers[:-1], numbers[1:]], axis=1), ranges[1:]
    else:
        logged = start = poses
        indices, second = np.stack([np.full(len(numbers), -1), numbers], axis=1), ranges
    if np.isnan(start).any():
        cure = "add --guess identity" if grid is None else "add --reference with a TUM trajectory"
        raise ValueError(f"--guess: {guess!r} needs a pose of every scan, and the log has none: {cure}")
    options: dict[str, Any] = {} if noise is None else {"noise": noise}
    rng = np.random.default_rng(seed)
    start = start + rng.uniform(-1, 1, start.shape) * (spread[0], spread[0], spread[1])
    for begin in range(0, len(second), _BATCH):
        part = slice(begin, begin + _BATCH)
        reference = ranges[:-1][part] if grid is None else grid
        match = match_scan(reference, second[part], scanner, start[part], method, backend, **options)
        yield LogMatches(indices[part], start[part], match, logged[part])


def trajectory(matches: LogMatches, first: Floats) -> Floats:
    """Return (S + 1, 3) poses of scans matched in sequence, or (S, 3) poses of scans matched to a map.

    A match that did not converge is replaced by its guess.

    ``first``: (3,) pose of the first scan [m, m, rad]; not used for matches to a map.
    """
    usable = matches.match.converged[:, None]
    steps = np.where(usable, matches.match.pose, matches.guess)
    if matches.indices[0, 0] < 0:
        return steps
    poses = [np.asarray(first, np.float64)]
    for step in steps:
        poses.append(compose_poses(poses[-1], step))
    return np.array(poses)


def joined(parts: list[LogMatches]) -> LogMatches:
    """Return the matches of several calls as one; at least one call."""
    return LogMatches(
        np.concatenate([part.indices for part in parts]), np.concatenate([part.guess for part in parts]),
        ScanMatch.joined([part.match for part in parts]), np.concatenate([part.logged for part in parts]),
    )  # fmt: skip


def summary(matches: LogMatches) -> dict[str, object]:
    """Return counts of statuses, and medians and 95th percentiles of errors (None without logged poses)."""
    names, counts = np.unique(matches.match.status, return_counts=True)
    result: dict[str, object] = {
        "matches": len(matches.match),
        "statuses": dict(zip(names.tolist(), counts.tolist(), strict=True)),
        "score_median": float(np.median(matches.match.score)),
    }
    known = np.isfinite(matches.logged).all(axis=1)
    pairs = {
        "": (matches.match.pose[known], matches.logged[known]),
        "guess_": (matches.guess[known], matches.logged[known]),
        "correction_": (matches.match.pose, matches.guess),
    }
    for kind, (poses, others) in pairs.items():
        for name, values in zip(("position", "heading"), differences(poses, others), strict=True):
            for label, share in (("median", 50), ("p95", 95)):
                result[f"{kind}{name}_{label}"] = float(np.percentile(values, share)) if len(values) else None
    result["wrong"] = int(matches.wrong[known].sum()) if known.any() else None
    return result
