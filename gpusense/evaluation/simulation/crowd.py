"""People near a robot: walking bodies and legs that hide the background."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpusense._util.typing import Floats

Rng = np.random.Generator
# Radii of bodies, and of legs; distance of a leg from the person's middle [m].
BODY, LEG, STANCE = 0.22, 0.07, 0.13
# Largest speed [m/s]; least and largest distance at which a person appears, and beyond which it leaves [m].
_SPEED, _BEGIN, _FAR, _TOO_NEAR, _TOO_FAR = 1.2, 0.8, 5.0, 0.45, 8.0
# Distance that a person keeps from walls [m]; mean time that a person stays [s]; most people.
_ROOM, _STAY, _MOST = 0.3, 20.0, 64


@dataclass
class _Person:
    x: float
    y: float
    heading: float
    speed: float
    legs: bool
    phase: float


class Crowd:
    """People who appear, walk and leave.

    Args:
        people: Most people at any time.
        hidden: Share of the beams that additional people hide on average.
        is_free: Whether people can stand at (P, 2) places in the world.
        period: Time between two scans [s].
        rng: Random generator.
    """

    def __init__(
        self, people: int, hidden: float, is_free: Callable[[Floats], NDArray[np.bool]], period: float, rng: Rng
    ) -> None:
        self._people, self._hidden, self._is_free = people, hidden, is_free
        self._period, self._rng = period, rng
        self._present: list[_Person] = []

    def leave(self) -> None:
        """Remove all people, since the robot was carried elsewhere."""
        self._present = []

    def discs(self) -> Floats:
        """Return (P, 3) discs of the people: x, y and radius [m]."""
        discs = []
        for one in self._present:
            if not one.legs:
                discs.append((one.x, one.y, BODY))
                continue
            stride = 0.25 * math.sin(one.phase) * min(one.speed, 1.0)
            c, s = math.cos(one.heading), math.sin(one.heading)
            for side in (STANCE, -STANCE):
                along = math.copysign(stride, side) * math.copysign(1.0, stride)
                discs.append((one.x - side * s + along * c, one.y + side * c + along * s, LEG))
        return np.array(discs).reshape(-1, 3)

    def ranges(self, laser: Floats, bearings: Floats, expected: Floats) -> tuple[Floats, NDArray[np.bool]]:
        """Advance to the next scan; return its ranges with the people, and the beams that they hide.

        ``laser``: (3,) pose of the laser. ``bearings``: (K, R) directions of the rays of each beam relative to the
        laser [rad]. ``expected``: (K,) ranges without people [m].
        """
        self._walk(laser)
        shorter = self._shortened(laser, bearings, expected)
        for _ in range(4 * _MOST):
            share = float(np.mean(shorter < expected)) if expected.size else 0.0
            wanted = len(self._present) < self._people or share < self._hidden - 0.5 / max(expected.size, 1)
            if not wanted or len(self._present) >= _MOST + self._people:
                break
            self._come(laser, bearings[:, bearings.shape[1] // 2], expected)
            shorter = self._shortened(laser, bearings, expected)
        while self._hidden > 0 and len(self._present) > self._people:
            if np.mean(shorter < expected) <= self._hidden + 0.05:
                break
            self._present.pop(int(self._rng.integers(len(self._present))))
            shorter = self._shortened(laser, bearings, expected)
        return shorter, shorter < expected

    def _walk(self, laser: Floats) -> None:
        rng, stay = self._rng, []
        for one in self._present:
            one.phase += 5.0 * one.speed * self._period
            one.heading += rng.normal(0, 0.3 * math.sqrt(self._period))
            x = one.x + one.speed * self._period * math.cos(one.heading)
            y = one.y + one.speed * self._period * math.sin(one.heading)
            if self._is_free(np.array([[x, y]]))[0]:
                one.x, one.y = x, y
            else:
                one.heading = rng.uniform(-math.pi, math.pi)
            distance = math.hypot(one.x - laser[0], one.y - laser[1])
            if _TOO_NEAR < distance < _TOO_FAR and rng.random() > self._period / _STAY:
                stay.append(one)
        self._present = stay

    def _come(self, laser: Floats, axes: Floats, expected: Floats) -> None:
        """Add a person in view of the laser, unless there is no room on the drawn beam."""
        rng = self._rng
        k = int(rng.integers(len(axes)))
        farthest = min(float(expected[k]) - _ROOM, _FAR)
        distance, speed, legs = rng.uniform(_BEGIN, _FAR), rng.uniform(0, _SPEED), rng.random() < 0.5
        heading, phase = rng.uniform(-math.pi, math.pi, 2)
        angle = laser[2] + axes[k]
        x, y = laser[0] + distance * math.cos(angle), laser[1] + distance * math.sin(angle)
        if distance <= farthest and self._is_free(np.array([[x, y]]))[0]:
            self._present.append(_Person(x, y, heading, speed, bool(legs), phase))

    def _shortened(self, laser: Floats, bearings: Floats, expected: Floats) -> Floats:
        """Return the least of the expected range and the ranges to all discs, over the rays of each beam."""
        discs = self.discs()
        if not len(discs):
            return expected.copy()
        angle = laser[2] + bearings[..., None]
        dx, dy = discs[:, 0] - laser[0], discs[:, 1] - laser[1]
        c, s = np.cos(angle), np.sin(angle)
        along, across = c * dx + s * dy, c * dy - s * dx
        inside = discs[:, 2] ** 2 - across * across
        near = along - np.sqrt(np.maximum(inside, 0))
        meets = (inside >= 0) & (near > 0)
        return np.minimum(np.where(meets, near, np.inf).min(axis=(1, 2)), expected)
