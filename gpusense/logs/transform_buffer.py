"""Transforms between frames over time, from ``tf2_msgs/TFMessage``, without ROS.

Look-ups follow tf2: chains in both directions, linear interpolation of positions, and rotations along the shorter arc.
Unlike tf2, a stamp that goes back by more than 2 s drops all later transforms of this link, as after a restarted
recording or a single stamp far ahead.
"""

from __future__ import annotations

import math
from array import array
from bisect import bisect_left
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gpusense.world.messages import field as field_of
from gpusense.world.messages import real_field, rotation_matrix, stamp_of, unit_quaternion

BACK = 2.0
"""Largest step back in time of messages out of order [s]."""
# Largest change of a transform that still counts as fixed [m, 1].
_FIXED = 1e-5
# Translation and quaternion (x, y, z, w).
_SIZE = 7
Vector = tuple[float, ...]


class TransformError(LookupError):
    """A transform is unknown, or unknown at the requested time; if ``early``, waiting helps."""

    def __init__(self, text: str, early: bool = False) -> None:
        super().__init__(text)
        self.early = early


@dataclass
class Link:
    """Transform between a frame and its parent; a stamp that goes back is stray unless the next one follows it."""

    parent: str
    child: str
    static: bool = False
    moved: bool = False  # True if a moving transform has changed
    times: array[float] = field(default_factory=lambda: array("d"))  # stamps in increasing order [s]
    values: array[float] = field(default_factory=lambda: array("d"))  # rows of translation [m] and quaternion, by stamp
    stray: tuple[float, Vector] | None = None  # time and value

    def put(self, time: float, value: Vector, static: bool) -> None:
        """Add a transform in the order of time; a static one replaces the others."""
        if static or self.static:
            self.static, self.moved = True, False
            self.times, self.values = array("d", [time]), array("d", value)
            return
        self.moved = self.moved or (len(self.times) > 0 and _apart(self._value(-1), value) > _FIXED)
        at = bisect_left(self.times, time)
        if at < len(self.times) and self.times[at] == time:
            self.values[at * _SIZE : (at + 1) * _SIZE] = array("d", value)
        elif at > 1 and at == len(self.times) and self._value(-1) == self._value(-2) == value:
            self.times[-1] = time
        else:
            self.times.insert(at, time)
            self.values[at * _SIZE : at * _SIZE] = array("d", value)

    def keep(self, oldest: float, newest: float) -> None:
        """Forget the transforms outside an interval of time, except the last one before it."""
        if self.static or not self.times:
            return
        last = bisect_left(self.times, math.nextafter(newest, math.inf))
        first = max(min(bisect_left(self.times, oldest), last) - 1, 0)
        self.times, self.values = self.times[first:last], self.values[first * _SIZE : last * _SIZE]

    def at(self, time: float) -> Vector:
        """Return the transform at a time."""
        if self.static:
            return self._value(0)
        if not self.times:
            raise TransformError(f"no transform from {self.parent} to {self.child} yet")
        if not self.times[0] <= time <= self.times[-1]:
            end, word = (self.times[0], "begins") if time < self.times[0] else (self.times[-1], "ends")
            raise TransformError(
                f"the transform from {self.parent} to {self.child} {word} at {end:.3f} s, asked for {time:.3f} s",
                early=time > self.times[-1],
            )
        k = bisect_left(self.times, time)
        if self.times[k] == time:
            return self._value(k)
        share = (time - self.times[k - 1]) / (self.times[k] - self.times[k - 1])
        return _between(self._value(k - 1), self._value(k), share)

    def _value(self, k: int) -> Vector:
        k %= len(self.times)
        return tuple(self.values[k * _SIZE : (k + 1) * _SIZE])


class TransformBuffer:
    """Transforms between frames over ``cache`` seconds. Slashes around a frame's name are ignored.

    In an infinite cache, as for a log, a single stamp that goes back drops nothing.
    """

    def __init__(self, cache: float = math.inf) -> None:
        self.cache = cache
        self._links: dict[tuple[str, str], Link] = {}

    def add(self, message: object, static: bool = False, time: float | None = None) -> bool:
        """Add a ``geometry_msgs/TransformStamped``; return whether its stamp went back and dropped later transforms.

        ``time`` [s] replaces the message's stamp.
        """
        parent, child = (
            str(field_of("message", message, name)).strip("/") for name in ("header.frame_id", "child_frame_id")
        )
        if not parent or not child or parent == child:
            raise ValueError(f"message.child_frame_id: must differ from header.frame_id {parent!r}, got {child!r}")
        place = [real_field("message", message, f"transform.translation.{axis}") for axis in "xyz"]
        turn = unit_quaternion("message.rotation", field_of("message", message, "transform.rotation"))
        time = stamp_of("message", message) if time is None else time
        link = self._links.setdefault((parent, child), Link(parent, child))
        back = not static and not link.static and len(link.times) > 0 and time < link.times[-1] - BACK
        stray, link.stray = link.stray, None
        if back and stray is None and self.cache == math.inf:
            link.stray = time, (*place, *turn)
            return False
        if back:
            self.forget_after(time if stray is None else min(time, stray[0]))
            if stray is not None:
                link.put(*stray, static)
        link.put(time, (*place, *turn), static)
        if link.times[-1] - link.times[0] > 1.5 * self.cache:
            link.keep(link.times[-1] - self.cache, math.inf)
        return back

    def forget_after(self, time: float) -> None:
        """Forget moving transforms later than a time, with 2 s of tolerance for other links."""
        for link in self._links.values():
            if not link.static:
                link.keep(-math.inf, time + BACK)

    def clear(self) -> None:
        """Forget moving transforms."""
        self._links = {key: link for key, link in self._links.items() if link.static}

    def links(self) -> Iterator[Link]:
        """Yield the links in the order of their first message."""
        yield from self._links.values()

    def look_up(self, target: str, source: str, time: float | None = None) -> NDArray[np.float64]:
        """Return the (4, 4) pose of ``source`` in ``target``; None as time [s] is the latest known to all links."""
        chain = self._chain(target, source, self._links.values())
        if time is None:
            time = min((link.times[-1] for link, _ in chain if not link.static and link.times), default=0.0)
        try:
            return _product((link.at(time), ahead) for link, ahead in chain)
        except TransformError as error:
            # A frame may have changed parents.
            known = [link for link in self._links.values() if _covers(link, time)]
            try:
                return _product((link.at(time), ahead) for link, ahead in self._chain(target, source, known))
            except TransformError:
                raise error from None

    def fixed(self, target: str, source: str) -> NDArray[np.float64]:
        """Return the (4, 4) pose of ``source`` in ``target``, which must be constant."""
        still = [link for link in self._links.values() if not link.moved]
        try:
            return _product((link.at(link.times[-1]), ahead) for link, ahead in self._chain(target, source, still))
        except TransformError:
            chain = self._chain(target, source, self._links.values())
        moving = next(link for link, _ in chain if link.moved)
        raise TransformError(f"the transform from {moving.parent} to {moving.child} changes")

    def history(self, target: str, source: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the (N,) times [s] and (N, 4, 4) poses of the motion of ``source`` in ``target``."""
        chain = self._chain(target, source, self._links.values())
        moving = [link for link, _ in chain if not link.static]
        stamps = sorted({time for link in moving for time in link.times})
        times = [time for time in stamps if all(_covers(link, time) for link in moving)]
        poses = [_product((link.at(time), ahead) for link, ahead in chain) for time in times]
        return np.array(times), np.array(poses).reshape(-1, 4, 4)

    def _chain(self, target: str, source: str, links: Iterable[Link]) -> list[tuple[Link, bool]]:
        """Return the shortest chain of links from target to source, each with whether it leads to its child."""
        target, source = target.strip("/"), source.lstrip("/")
        ways: dict[str, list[tuple[str, Link, bool]]] = {}
        for link in links:
            ways.setdefault(link.parent, []).append((link.child, link, True))
            ways.setdefault(link.child, []).append((link.parent, link, False))
        reached: dict[str, list[tuple[Link, bool]]] = {target: []}
        queue = deque([target])
        while queue and source not in reached:
            at = queue.popleft()
            for other, link, ahead in ways.get(at, []):
                if other not in reached:
                    reached[other] = [*reached[at], (link, ahead)]
                    queue.append(other)
        if source not in reached:
            absent = [name for name in (target, source) if name not in ways]
            why = f"no transform names {' or '.join(absent)}" if absent else "the frames are not connected"
            raise TransformError(f"no transform from {target} to {source}: {why}")
        return reached[source]


def _covers(link: Link, time: float) -> bool:
    return link.static or (len(link.times) > 0 and link.times[0] <= time <= link.times[-1])


def _apart(first: Vector, second: Vector) -> float:
    """Return the largest difference of translations and of quaternions."""
    sign = math.copysign(1.0, sum(a * b for a, b in zip(first[3:], second[3:], strict=True)))
    return max(abs(a - b) for a, b in zip(first, (*second[:3], *(sign * q for q in second[3:])), strict=True))


def _between(first: Vector, second: Vector, share: float) -> Vector:
    """Interpolate between two transforms."""
    place = (a + share * (b - a) for a, b in zip(first[:3], second[:3], strict=True))
    cosine = sum(a * b for a, b in zip(first[3:], second[3:], strict=True))
    sign, cosine = (-1.0, -cosine) if cosine < 0 else (1.0, cosine)
    angle = math.acos(min(cosine, 1.0))
    if angle < 1e-6:
        start, end = 1 - share, share
    else:
        start, end = math.sin((1 - share) * angle) / math.sin(angle), math.sin(share * angle) / math.sin(angle)
    turn = [start * a + sign * end * b for a, b in zip(first[3:], second[3:], strict=True)]
    size = math.hypot(*turn)
    return *place, *(q / size for q in turn)


def _product(chain: Iterable[tuple[Vector, bool]]) -> NDArray[np.float64]:
    """Return the product of the matrices of a chain, inverted where a link leads to its parent."""
    product = np.eye(4)
    for value, ahead in chain:
        rotation, place = rotation_matrix(*value[3:]), np.array(value[:3])
        matrix = np.eye(4)
        matrix[:3, :3] = rotation if ahead else rotation.T
        matrix[:3, 3] = place if ahead else -rotation.T @ place
        product = product @ matrix
    return product
