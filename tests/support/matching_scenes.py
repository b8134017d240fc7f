"""Scans of simple scenes for tests of matching, from closed forms."""

from __future__ import annotations

import numpy as np

import gpusense as gs

RING = gs.Scanner.uniform(angle_min=-np.pi, angle_increment=np.pi / 180, count=360, range_max=30.0)
FRONT = gs.Scanner.uniform(angle_min=-np.pi / 2, angle_increment=np.pi / 180, count=181, range_max=30.0)


def segments_scan(segments: np.ndarray, pose: tuple[float, float, float], scanner: gs.Scanner) -> np.ndarray:
    """Return exact ranges to (M, 4) wall segments x1 y1 x2 y2, infinite for beams that miss."""
    angle = scanner.bearings + pose[2]
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)[:, None]
    start, along = segments[None, :, :2] - np.array(pose[:2]), segments[None, :, 2:] - segments[None, :, :2]
    across = direction[..., 0] * along[..., 1] - direction[..., 1] * along[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (start[..., 0] * along[..., 1] - start[..., 1] * along[..., 0]) / across
        u = (start[..., 0] * direction[..., 1] - start[..., 1] * direction[..., 0]) / across
    hit = (t > 0) & (u >= 0) & (u <= 1) & (across != 0)
    nearest = np.where(hit, t, np.inf).min(axis=1, initial=np.inf)
    return np.where(nearest < scanner.range_max, nearest, np.inf)


def box(x1: float, y1: float, x2: float, y2: float) -> list[list[float]]:
    """Return the four walls of a box."""
    return [[x1, y1, x2, y1], [x2, y1, x2, y2], [x2, y2, x1, y2], [x1, y2, x1, y1]]


ROOM = np.array([*box(-4, -3, 5, 4), *box(1.5, 1.0, 2.5, 2.2), *box(-2.5, -2.0, -1.8, -1.0)])
CORRIDOR = np.array([[-200.0, -1.2, 200.0, -1.2], [-200.0, 1.4, 200.0, 1.4]])
WALL = np.array([[-200.0, 1.5, 200.0, 1.5]])
SQUARE = np.array(box(-3, -3, 3, 3))


def table_legs(seed: int) -> np.ndarray:
    """Return the walls of 60 table legs of 10 cm around a robot."""
    place = np.random.default_rng(seed).uniform(-6, 6, (60, 2))
    place = place[np.hypot(*place.T) > 1.2]
    return np.array([wall for x, y in place for wall in box(x - 0.05, y - 0.05, x + 0.05, y + 0.05)])


def random_pairs(count: int, scanner: gs.Scanner, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return scans of ROOM from pairs of neighbouring poses, and the second poses in the first frames."""
    rng = np.random.default_rng(seed)
    first = np.column_stack([rng.uniform(-1.2, 1.2, (count, 2)), rng.uniform(-3, 3, count)])
    second = first + np.column_stack([rng.uniform(-0.4, 0.4, (count, 2)), rng.uniform(-0.2, 0.2, count)])
    scans = [np.array([segments_scan(ROOM, tuple(pose), scanner) for pose in poses]) for poses in (first, second)]
    return scans[0], scans[1], gs.pose_difference(first, second)
