"""Find the likeliest poses of a scan on a whole map, candidates that later scans distinguish."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gpusense.matching.field_search import field_search
from gpusense.matching.locate import end_points_of
from gpusense.matching.pose_grid import PoseGrid, distinct_poses
from gpusense.models.scan.field import LikelihoodFieldModel

# Distance and angle between neighbouring poses [m, rad]; a cloud of particles covers half of each.
_RESOLUTION, _ANGLE = 0.1, math.radians(3.0)
# Depth of scores below the best one to which poses are searched; poses nearer than this to a better one are dropped.
_DEPTH, _NEAR, _TURNED = 0.06, 0.5, math.radians(15.0)


def likely_poses(model: LikelihoodFieldModel, ranges: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Return at most ``count`` distinct poses (M, 3) in free cells at which a scan (K,) is likeliest, best first.

    Branch and bound, as in :func:`gpusense.matching.locate.locate_scan`, on a coarser grid of poses. Poses are 0.5 m or
    15 degrees apart; none for a scan without hits, on a map without free cells, or on one whose cells are larger than
    the scan.
    """
    grid = model.grid
    stride = max(round(_RESOLUTION / grid.resolution), 1)
    points = end_points_of(model, ranges[None])[1][0]
    search = field_search(model, stride)
    # Within a single cell no end point depends on the heading, and all free cells far from walls are alike.
    if not len(points) or not search.free.any() or grid.resolution > np.hypot(*points.T).max():
        return np.empty((0, 3))
    turns = 4 * math.ceil(math.pi / 2 / _ANGLE)
    rows, columns = (-(-size // stride) for size in grid.shape)
    searched = PoseGrid(np.array([[0.5, 0.5]]), 2 * math.pi / turns * np.arange(turns)[None], rows, columns)
    with search.lock:
        poses = search.find(ranges[None], [points], searched, search.free, _DEPTH)[0].poses
    return poses[distinct_poses(poses, count, _NEAR, _TURNED)]
