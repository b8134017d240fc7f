"""Beacons, a robot among them, and noiseless measurements."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

import gpusense as gs

XY = np.array([[0.0, 0.0], [10.0, 1.0], [3.0, 8.0], [-4.0, 5.0], [2.0, -6.0]])
POSE = np.array([2.5, 3.1, 2.9])


@dataclass(frozen=True)
class Case:
    """A public function and its number of beacons; ``heading`` is True if it gets the heading."""

    name: str
    kind: str
    beacons: int
    heading: bool = False

    def solve(self, xy, values, theta=0.0, **options) -> gs.PositionFix:
        """Return the fix; values are ranges, bearings, or both in sequence, with their deviations."""
        known = theta if self.heading else None
        if self.kind == "ranges":
            return gs.trilaterate(xy, values, **options)
        if self.kind == "triangle":
            return gs.triangulate_triangle(xy, values, **options)
        if self.kind == "bearings":
            return gs.triangulate(xy, values, known, **options)
        half = len(values) // 2
        sigma = np.asarray(options.pop("sigma"))
        return gs.locate(
            xy, values[:half], values[half:], known, sigma_range=sigma[:half], sigma_bearing=sigma[half:], **options
        )

    def measure(self, xy, pose):
        """Return the measurements from a pose, without noise."""
        x, y, theta = pose
        dx, dy = xy[:, 0] - x, xy[:, 1] - y
        ranges, bearings = np.hypot(dx, dy), np.arctan2(dy, dx) - theta
        bearings = np.array([math.remainder(b, 2 * math.pi) for b in bearings])
        return {"ranges": ranges, "both": np.append(ranges, bearings)}.get(self.kind, bearings)

    def sigmas(self, count):
        """Return small deviations that differ from beacon to beacon."""
        ranges, bearings = 0.02 + 0.01 * np.arange(count), 0.002 + 0.001 * np.arange(count)
        return {"ranges": ranges, "both": np.append(ranges, bearings)}.get(self.kind, bearings)


CASES = [
    Case("two circles", "ranges", 2),
    Case("three ranges", "ranges", 3),
    Case("five ranges", "ranges", 5),
    Case("two rays", "bearings", 2, True),
    Case("four rays", "bearings", 4, True),
    Case("triangle", "triangle", 3),
    Case("three bearings", "bearings", 3),
    Case("five bearings", "bearings", 5),
    Case("one with heading", "both", 1, True),
    Case("two of both", "both", 2),
    Case("four of both", "both", 4),
    Case("three of both with heading", "both", 3, True),
]
