"""Skip beams that most particles cannot explain, such as beams on people and moved furniture.

In nav2_amcl's ``do_beamskip`` a particle explains a beam that ends within 0.5 m of a wall. Here it explains a beam that
it makes likelier than poses anywhere do, so that any model of scans can skip. Two faults of nav2_amcl are absent:
nonexistent beams do not count as skipped, and a scan with too many skipped beams is used completely, with the
log-likelihoods of all its beams. Scans are also used completely while the particles are spread out, since then only
the few right particles explain most beams.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from gpusense.backends import arrays
from gpusense.localization.cloud_state import SensorReadings
from gpusense.localization.pose_algebra import mean_pose
from gpusense.localization.sensors import Sensor
from gpusense.localization.spread import WIDE

# Number of evaluated particles; largest share of skipped beams.
_ASKED, _MOST_SKIPPED = 100, 0.7


def together(poses: np.ndarray, weights: np.ndarray) -> bool:
    """Return whether the deviation of particles is at most half a metre along x and along y."""
    d = poses[:, :2] - mean_pose(poses, weights)[:2]
    return bool(np.all(weights @ d**2 <= WIDE**2 * weights.sum()))


def skipped(
    sensors: Sequence[Sensor],
    readings: list[SensorReadings],
    particles: tuple[np.ndarray, np.ndarray],
    anywhere: Callable[[], np.ndarray],
    share: float,
) -> list[SensorReadings]:
    """Return readings without the beams that less than a share of (N, 3) particles, by (N,) weights, explains."""
    poses, weights = particles
    if not together(poses, weights):
        return readings
    asked = slice(None, None, max(len(poses) // _ASKED, 1))
    few, elsewhere = (poses[asked], weights[asked]), anywhere()
    return [
        (i, without_skipped(sensors[i], reading, *few, elsewhere, share) if sensors[i].calibrates else reading)
        for i, reading in readings
    ]


def without_skipped(
    sensor: Sensor,
    reading: tuple[Any, ...],
    poses: np.ndarray,
    weights: np.ndarray,
    elsewhere: np.ndarray,
    share: float,
) -> tuple[Any, ...]:
    """Return a scan with missing readings for the beams that less than a share of the particles explains."""
    parts = sensor.parts(np.vstack([poses, elsewhere]), reading)
    near, far = parts[: len(poses)], parts[len(poses) :]
    used = (near != 0).any(axis=0)
    least = boundary(far[:, used])
    if least is None:
        return reading
    explained = weights @ (near > least) >= share * weights.sum()
    if np.count_nonzero(used & ~explained) > _MOST_SKIPPED * np.count_nonzero(used):
        return reading
    ranges = np.array(arrays.copied_to_host(reading[0], sensor.backend, "ranges"))
    ranges[~(used & explained)] = np.nan
    return (ranges, *reading[1:])


def boundary(elsewhere: np.ndarray) -> float | None:
    """Return the least log-likelihood of an explained beam, from (M, K) at poses anywhere; None if all are alike."""
    values = elsewhere[np.isfinite(elsewhere)]
    if not values.size:
        return None
    poor, good = np.percentile(values, (50, 99))
    return float((poor + good) / 2) if good > poor else None
