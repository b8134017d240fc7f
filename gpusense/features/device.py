"""Run the kernels that find straight segments and circles of scans."""

from __future__ import annotations

from typing import Any

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.workspace import Workspace
from gpusense.interface.constants import CIRCLE_NUMBERS, LINE_NUMBERS
from gpusense.interface.flags import flags_if
from gpusense.interface.launches import launch
from gpusense.matching.points import ScanPoints

_INT = np.dtype(np.int32)


class ScanDevice:
    """Points of scans on a device, and their noise."""

    def __init__(self, backend: Backend, real: np.dtype, points: ScanPoints, noise: np.ndarray) -> None:
        self._backend, self._real = backend, real
        self._flags = flags_if(FLOAT64=real == np.float64)
        self._sizes = {"scans": len(noise), "points": len(points.point)}
        self._gap = points.gap
        self._space = Workspace(backend)
        self._arrays = {"point": points.point.astype(real), "start": points.start, "noise": noise.astype(real)}

    def split(self, penalty: float, point: np.ndarray) -> np.ndarray:
        """Return, for each point in splitting order, the end of the segment that begins there, or -1.

        ``penalty`` is the least reduction of the cost for replacing a line by two.
        """
        points = self._sizes["points"]
        stop = np.empty(points, _INT)
        with self._space as space:
            cost = space.empty("cost", points, self._real)
            out = space.empty("stop", points, _INT)
            placed = space.upload("ordered", point.astype(self._real))
            self._run("split_scans", self._sizes["scans"], point=placed, cost=cost, stop=out, penalty=penalty,
                      gap=self._gap)  # fmt: skip
            space.download(out, stop)
            space.wait()
        return stop

    def lines(self, part: np.ndarray, scan: np.ndarray) -> np.ndarray:
        """Return the lines (P, 6) of parts (P, 2) of scans, as the kernel file describes them."""
        return self._parts("fit_segments", "line", LINE_NUMBERS, part, scan)

    def circles(self, part: np.ndarray, scan: np.ndarray, edge: np.ndarray) -> np.ndarray:
        """Return the circles (P, 10) of parts of scans, with edges (P, 4), as the kernel file describes them."""
        return self._parts("fit_circles", "circle", CIRCLE_NUMBERS, part, scan, edge=edge.astype(self._real))

    def _parts(
        self, kernel: str, name: str, numbers: int, part: np.ndarray, scan: np.ndarray, **more: np.ndarray
    ) -> np.ndarray:
        """Return the (P, numbers) array that a kernel writes, one row per part."""
        count = len(part)
        found = np.empty((count, numbers), self._real)
        if count:
            with self._space as space:
                out = space.empty(name, numbers * count, self._real)
                arrays = {"part": part.astype(_INT), "scan": scan.astype(_INT), **more}
                uploaded = {key: space.upload(key, value) for key, value in arrays.items()}
                self._run(kernel, count, **uploaded, **{name: out}, parts=count)
                space.download(out, found)
                space.wait()
        return found.astype(np.float64)

    def _run(self, kernel: str, size: int, **arguments: Any) -> None:
        """Launch a kernel on the points."""
        placed = {key: self._space.upload(key, value) for key, value in self._arrays.items() if key not in arguments}
        self._backend.run((launch(kernel, self._flags, (size,), **placed, **self._sizes, **arguments),))
