"""Point-to-line ICP of many pairs of scans on a device."""

from __future__ import annotations

import threading
import weakref

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.workspace import Workspace
from gpusense.interface.constants import MATCH_RESULT
from gpusense.interface.flags import flags_if
from gpusense.interface.lanes import widened
from gpusense.interface.launches import launch
from gpusense.interface.structs import MatchRules
from gpusense.matching.points import ScanPoints

# Neighbours on either side to which a line is fitted, and how far they may be from one another: a share of the range
# and a distance [m]. Bodies in vectors have room for 16.
REACH, _MOST, _RATIO, _SLACK = 2, 16, 0.1, 0.05
# Half of the least length of a line, in standard deviations of ranges.
_WIDTH = 4.0
# Most starts of one launch; a call can be interrupted between launches.
_MOST_STARTS = {"cpu": 1 << 12, "gpu": 1 << 18}

_SPACES: weakref.WeakKeyDictionary[Backend, tuple[threading.RLock, Workspace]] = weakref.WeakKeyDictionary()
_LOCK = threading.Lock()


def space_of(backend: Backend) -> tuple[threading.RLock, Workspace]:
    """Return the buffers of matches on a device, and the lock of their owner."""
    with _LOCK:
        return _SPACES.setdefault(backend, (threading.RLock(), Workspace(backend)))


class IcpPairs:
    """Pairs of scans on a device.

    Args:
        backend: The device.
        real: Precision.
        points: The points of all scans.
        pairs: (S, 2) numbers of the reference and of the second scan.
        noise: Standard deviation of ranges [m].
        space: Holds the buffers.
    """

    def __init__(
        self, backend: Backend, real: np.dtype, points: ScanPoints, pairs: np.ndarray, noise: float, space: Workspace
    ):
        self._backend, self._real, self._space = backend, real, space
        self._flags = flags_if(FLOAT64=real == np.float64)
        self._pairs = np.ascontiguousarray(pairs, np.int32)
        self._counts = len(points.start) - 1, len(points.point)
        point = points.point if len(points.point) else np.zeros((1, 4), real)
        self._point, self._start = space.upload("match points", point), space.upload("match start", points.start)
        self._line = space.empty("match lines", point.size, real)
        most = int(points.counts.max(initial=0))
        if most:
            flags = widened(backend.info.lanes, "fit_lines", self._flags)
            lines = launch(
                "fit_lines", flags, (most, self._counts[0]), point=self._point, start=self._start, line=self._line,
                scans=self._counts[0], points=self._counts[1], reach=REACH, most=_MOST, ratio=_RATIO, slack=_SLACK,
                width=_WIDTH * noise,
            )  # fmt: skip
            backend.run((lines,))

    def run(self, pairs: np.ndarray, guesses: np.ndarray, rules: MatchRules) -> np.ndarray:
        """Match some pairs from several guesses each.

        Args:
            pairs: (P,) numbers of pairs.
            guesses: (P, M, 3) poses of the second scan in the reference's frame.
            rules: See the kernel file ``icp``.

        Returns:
            (P, M, 32) results in float64, as the kernel file describes them.
        """
        starts = guesses.shape[1]
        result = np.empty((len(pairs), starts, MATCH_RESULT), self._real)
        step = max(_MOST_STARTS[self._backend.info.kind] // max(starts, 1), 1)
        for begin in range(0, len(pairs), step):
            self._run(pairs[begin : begin + step], guesses[begin : begin + step], rules, result[begin : begin + step])
        return result.astype(np.float64)

    def _run(self, pairs: np.ndarray, guesses: np.ndarray, rules: MatchRules, result: np.ndarray) -> None:
        """Match the pairs of one launch."""
        count, starts = guesses.shape[:2]
        padded = np.zeros((count, starts, 4), self._real)
        padded[..., :3] = guesses
        space = self._space
        buffer = space.empty("match result", result.size, self._real)
        flags = widened(self._backend.info.lanes, "match_scans", self._flags)
        matching = launch(
            "match_scans", flags, (count * starts,), point=self._point, start=self._start, line=self._line,
            pair=space.upload("match pairs", self._pairs[pairs]), guess=space.upload("match guesses", padded),
            result=buffer, scans=self._counts[0], points=self._counts[1], pairs=count, starts=starts, rules=rules,
        )  # fmt: skip
        self._backend.run((matching,))
        space.download(buffer, result)
        space.wait()
