"""Judge the beams of a scan against the map at a pose: agreeing, too short, or through walls.

Each judged beam is traced through the map with two diverging companion rays, so that a slightly wrong pose, the edge
of a door or a grazed wall is no evidence. A beam

- **agrees** if its reading is between the walls of the three rays, within a tolerance;
- **passes through** if all three meet a wall well before the reading: no person or box lengthens a beam;
- is **short** if it ends in mapped free space and no ray has met a wall: people, furniture, or a wrong pose;
- is **no** evidence if unknown cells or the map's edge come first, if the rays contradict each other, or without a
  reading.

The walk needs only grid and pose, and costs the same for every model: a few thousand look-ups per scan, on the map's
device or on the host. A diagonal pair of walls stops a ray, as in the casters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gpusense._util.typing import Floats
from gpusense.interface.constants import AGREES, NOTHING, SHORT, THROUGH
from gpusense.localization.map_judge import BESIDE, MapJudge, chosen_beams, judged_on_host
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Scanner

# Largest distance of close agreement [m].
_CLOSE = 0.1
_STILL = np.zeros((3, 3))


class BeamConsistency(NamedTuple):
    """Judged beams of a scan."""

    kind: Floats  # (B,) class of each beam
    distance: Floats  # (B,) range to the first mapped wall before the beam's end, inf without one [m]
    bearing: Floats  # (B,) bearing from the scanner [rad]
    reading: Floats  # (B,) its reading [m]
    origin: tuple[float, float]  # origin of the beams [m]
    heading: float  # direction of bearing 0 in the world [rad]
    near: float  # largest distance of close agreement [m]
    inside: bool  # true if the pose is inside solid cells
    off: bool  # true if the pose is in unknown cells or off the map

    @property
    def wall(self) -> Floats:
        """(B, 2) first mapped wall on each beam, NaN without one before its end [m]."""
        distance = np.where(self.distance < np.inf, self.distance, np.nan)[:, None]
        direction = self.heading + self.bearing
        return np.asarray(self.origin + distance * np.column_stack([np.cos(direction), np.sin(direction)]))

    @property
    def close(self) -> int:
        """Number of beams in close agreement."""
        # Python's numbers are faster than short arrays.
        beams = zip(self.kind.tolist(), self.reading.tolist(), self.distance.tolist(), strict=True)
        return sum([abs(reading - distance) < self.near for kind, reading, distance in beams if kind == AGREES])

    def count(self, kind: int) -> int:
        """Return the number of beams of a class."""
        return int(np.count_nonzero(self.kind == kind))


class Counts(NamedTuple):
    """Counts of the beams of simultaneous scans, by their evidence."""

    agree: int  # agreeing beams
    close: int  # beams in close agreement
    through: int  # beams that pass through walls
    short: int  # short beams
    nothing: int  # beams without evidence

    @property
    def informative_count(self) -> int:
        """Number of beams that agree, pass through, or are short."""
        return self.agree + self.through + self.short


def counts_of(scans: Sequence[BeamConsistency]) -> Counts:
    """Return the counts of several scans."""
    kinds = [kind for one in scans for kind in one.kind.tolist()]
    close = sum(one.close for one in scans)
    return Counts(kinds.count(AGREES), close, kinds.count(THROUGH), kinds.count(SHORT), kinds.count(NOTHING))


def beam_consistency(
    grid: OccupancyGrid,
    scanner: Scanner,
    pose: Floats,
    ranges: Floats,
    covariance: Floats = _STILL,
    judge: MapJudge | None = None,
) -> BeamConsistency:
    """Judge the beams of a scan (K,) at a (3,) pose with a (3, 3) covariance, by the map on a device or on the host."""
    if judge is None:
        beams = chosen_beams(scanner, ranges)
        judged = judged_on_host(grid, scanner, pose, covariance, beams)
    else:
        beams, judged = judge(scanner, pose, covariance, ranges)
    count = len(beams.bearing)
    return BeamConsistency(
        judged[:count], judged[count:], *beams, *_origin_of(pose, scanner.mount), max(_CLOSE, grid.resolution),
        *_place_of(grid, pose),
    )  # fmt: skip


def _origin_of(pose: Floats, mount: tuple[float, float, float]) -> tuple[tuple[float, float], float]:
    """Return the origin of the beams, and the direction of bearing 0."""
    (x, y, theta), (mount_x, mount_y, turn) = pose.tolist(), mount
    c, s = math.cos(theta), math.sin(theta)
    return (x + c * mount_x - s * mount_y, y + s * mount_x + c * mount_y), theta + turn


def _place_of(grid: OccupancyGrid, pose: Floats) -> tuple[bool, bool]:
    """Return whether all cells around a pose are solid, and whether all are unknown or off the map."""
    (x, y, _), (x0, y0, yaw) = pose.tolist(), grid.origin
    c, s = math.cos(yaw), math.sin(yaw)
    dx, dy = x - x0, y - y0
    column = math.floor((c * dx + s * dy) / grid.resolution)
    row = math.floor((-s * dx + c * dy) / grid.resolution)
    reach = max(1, round(BESIDE / grid.resolution))
    rows, columns = grid.shape
    if not (-reach <= row < rows + reach and -reach <= column < columns + reach):
        return False, True
    if 0 <= row < rows and 0 <= column < columns and 0 <= grid.cells[row, column] < grid.occupied_threshold:
        return False, False
    cells = grid.cells[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
    if not cells.size:
        return False, True
    solid = bool((cells >= grid.occupied_threshold).all())
    return solid, not solid and bool((cells < 0).all())
