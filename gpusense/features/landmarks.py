"""Maps of landmarks and lines, from features of scans along a trajectory or from an occupancy grid."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense.backends import Selection
from gpusense.features.clusters import clustered
from gpusense.features.extract import extract_features
from gpusense.features.feature_map import LANDMARK_KINDS, MAP_KINDS, FeatureMap, joined_maps, kinds_of
from gpusense.features.line_clusters import lines_of
from gpusense.features.result import Features, Floats
from gpusense.models.scan.caster import RayCaster
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Scanner

# Scans cast in a map: beams, range [m], distance between their positions [m] and from obstacles [m].
_BEAMS, _RANGE, _SPACING, _CLEARANCE = 720, 12.0, 1.0, 0.3
# Most scans cast in a map, and least number of them that must show a landmark.
_MOST_SCANS, _VIEWS = 4000, 3


def map_features(
    features: Features,
    poses: ArrayLike,
    *,
    kinds: str | Sequence[str] = MAP_KINDS,
    pose_deviation: ArrayLike = (0.03, 0.01),
    least: int = 2,
) -> FeatureMap:
    """Make landmarks and lines from the features of scans at known poses.

    Features of one kind, direction and size form one landmark if they lie within four standard deviations of each
    other. Its position is the mean of theirs, weighted by their information. Lines are joined if they agree in
    direction and offset within four standard deviations, and overlap or nearly do. Hallways have no position.

    Args:
        features: Features of S scans.
        poses: (S, 3) poses of the robot at the scans [m, m, rad].
        kinds: Kinds out of "line", "corner", "door", "pole" and "reflector".
        pose_deviation: Standard deviations of the poses: position [m] and heading [rad].
        least: Least number of features of a landmark, in different scans.

    Raises:
        TypeError: an argument is of the wrong kind.
        ValueError: an argument breaks its rule; the message names both.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> scanner = gs.Scanner.uniform(angle_min=-3.1, angle_increment=0.0175, count=356, range_max=9.0)
        >>> b = scanner.bearings
        >>> room = np.minimum(3 / np.abs(np.cos(b)), 2 / np.abs(np.sin(b)))
        >>> features = gs.extract_features(np.tile(room, (3, 1)), scanner, backend="numpy")
        >>> gs.map_features(features, np.zeros((3, 3)))
        FeatureMap(4 lines, 4 corners)
    """
    checks.instance("features", features, Features)
    wanted = kinds_of(kinds, MAP_KINDS)
    placed = checks.array("poses", poses, ("S", 3), largest=checks.FARTHEST)
    scans = int(features.scan.max(initial=-1)) + 1
    if len(placed) < scans:
        raise ValueError(f"poses: must have a pose of each of {scans} scans, got {len(placed)}")
    spread = checks.array("pose_deviation", pose_deviation, (2,), largest=checks.FARTHEST)
    if (spread < 0).any():
        raise ValueError(f"pose_deviation: must be at least 0, got {checks.show(spread)}")
    enough = checks.integer("least", least, low=1)
    parts = [clustered(features[name], placed, spread, name, enough) for name in LANDMARK_KINDS if name in wanted]
    if "line" in wanted:
        parts.insert(0, lines_of(features["line"], placed, spread, enough))
    return joined_maps(parts)


def landmarks_of_map(
    grid: OccupancyGrid,
    *,
    kinds: str | Sequence[str] = MAP_KINDS,
    range_max: float = _RANGE,
    spacing: float = _SPACING,
    backend: Selection = "auto",
) -> FeatureMap:
    """Make landmarks and lines from the features that a scanner would see in a map.

    Scans of 720 beams are cast from free places all over the map, and their features are clustered as by
    :func:`map_features`. The rounding of walls to cells counts as noise.

    Args:
        grid: The map.
        kinds: Kinds out of "line", "corner", "door", "pole" and "reflector".
        range_max: Range of the scans [m].
        spacing: Distance between neighbouring scans [m]; enlarged where there would be more than 4000 of them.
        backend: The device, see ``gpusense.devices()``.

    Raises:
        TypeError: an argument is of the wrong kind.
        ValueError: an argument breaks its rule; the message names both.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> cells = np.zeros((80, 120), np.int8)
        >>> cells[[0, -1]] = cells[:, [0, -1]] = 100
        >>> gs.landmarks_of_map(gs.OccupancyGrid(cells, resolution=0.05), backend="numpy")
        FeatureMap(4 lines, 4 corners)
    """
    checks.instance("grid", grid, OccupancyGrid)
    kinds = kinds_of(kinds, MAP_KINDS)
    limit = checks.real("range_max", range_max, above=0, high=checks.FARTHEST)
    poses = _free_places(grid, checks.real("spacing", spacing, low=checks.SMALLEST, high=checks.FARTHEST))
    scanner = Scanner(np.arange(_BEAMS) * (2 * math.pi / _BEAMS) - math.pi, limit)
    ranges = np.zeros((0, _BEAMS))
    if len(poses):
        ranges = np.asarray(RayCaster(grid, limit, backend=backend).cast(poses, scanner.bearings), np.float64)
    features = extract_features(ranges, scanner, kinds, backend, noise=0.5 * grid.resolution)
    return map_features(features, poses, kinds=kinds, pose_deviation=(0.5 * grid.resolution, 0.0), least=_VIEWS)


def _free_places(grid: OccupancyGrid, spacing: float) -> Floats:
    """Return (S, 3) poses with heading 0 on a lattice of free cells away from obstacles."""
    from scipy.ndimage import distance_transform_edt

    blocked = np.pad(grid.occupied | grid.unknown, 1, constant_values=True)
    room = distance_transform_edt(~blocked)[1:-1, 1:-1] * grid.resolution
    step = max(round(spacing / grid.resolution), 1)
    while True:
        first = min(step // 2, min(grid.shape) // 2)
        part = room[first::step, first::step]
        rows, cols = np.nonzero(part > min(_CLEARANCE, 0.5 * room.max(initial=0.0)))
        if len(rows) <= _MOST_SCANS:
            break
        step = math.ceil(step * math.sqrt(len(rows) / _MOST_SCANS) * 1.02)
    x = (first + step * cols + 0.5) * grid.resolution
    y = (first + step * rows + 0.5) * grid.resolution
    ox, oy, yaw = grid.origin
    c, s = math.cos(yaw), math.sin(yaw)
    return np.column_stack([ox + c * x - s * y, oy + s * x + c * y, np.zeros(len(x))])
