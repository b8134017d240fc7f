"""Beginnings of a particle filter: particles from a density, anywhere on the map, or from a likelihood."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense._util.typing import AnyArray
from gpusense.localization import starts
from gpusense.localization.calibration import is_together
from gpusense.localization.defaults import DEFAULTS
from gpusense.localization.journal import whole
from gpusense.localization.motion import SampledMotion
from gpusense.localization.results import Results
from gpusense.localization.rival import COMPARISONS
from gpusense.world.plausible import look_at_heading, look_at_start


class Beginnings(Results):
    """The part of a particle filter that places its particles."""

    # Number of the last step, the motion that the next one begins with, and corrections left at a low temperature.
    _step: int
    _pending: SampledMotion | None
    _wide: int
    # Whether the particles lie together, as far as is known.
    _together: bool
    # Poses that recovery injects: their number, and half widths of the box around each.
    _pool: tuple[int, starts.Spread]
    # How many places anywhere are still to be compared with the one that is found.
    _everywhere: int

    @whole
    def initialize(self, *, mean: AnyArray, covariance: AnyArray, particles: int | None = None) -> None:
        """Draw particles from a normal density.

        Args:
            mean: (3,) pose [m, m, rad].
            covariance: (3, 3) covariance, positive semidefinite.
            particles: Their number; the filter's (most) by default.

        Raises:
            TypeError, ValueError: an argument breaks its rule.

        Warns:
            PlausibilityWarning: the mean lies off the map, or its heading is more than a turn.
        """
        self._place(starts.normal(mean, covariance, self._number(particles), self._key()))
        self._look_at_start(np.asarray(mean, np.float64))
        self._together = is_together(np.asarray(covariance))

    @whole
    def initialize_uniform(self, *, bounds: AnyArray | None = None, particles: int | None = None) -> None:
        """Draw particles uniformly over the free cells of the map, with any heading.

        Without bounds and with ``recovery="sensor"``, the pose to which they converge is compared with other places.

        Args:
            bounds: ((x_min, y_min), (x_max, y_max)) [m]: only there. Needed for models without a grid.
            particles: Their number; the filter's (most) by default.

        Raises:
            TypeError, ValueError: an argument breaks its rule, or no cell is free.
        """
        pool, spread = starts.free_pool([sensor.model for sensor in self._sensors], bounds)
        self._place(starts.spread(pool, spread, self._number(particles), self._key()))
        self._wide = DEFAULTS.wide_scans
        self._verdict.reset(anywhere=True)
        self._everywhere = COMPARISONS if bounds is None else 0

    @whole
    def initialize_from(self, likelihood: Any, *, particles: int | None = None) -> None:
        """Draw particles from a likelihood over poses.

        Args:
            likelihood: The result of :func:`pose_likelihood`, or an object with ``log_p``, an array of M
                log-likelihoods of any shape, and ``positions``, (M, 3) poses in the same order. Particles are spread
                over the cells of its ``resolution`` [m] and the gaps of its ``headings``, if it has these.
            particles: Their number; the filter's (most) by default.

        Raises:
            TypeError, ValueError: it has not these, or no finite log-likelihood.

        Example:
            >>> import gpusense as gs
            >>> grid, scanner = gs.OccupancyGrid([[0, 0, 100]], 1.0), gs.Scanner([0.0], 9.0)
            >>> model = gs.LikelihoodFieldModel(grid, scanner, backend="numpy")
            >>> pf = gs.ParticleFilter(model, particles=100)
            >>> pf.initialize_from(gs.pose_likelihood(model, [1.9], resolution=1.0, headings=4))
            >>> pf.host_particles().shape
            (100, 3)
        """
        pool, spread = starts.likely_pool(likelihood, self._number(particles), self._key())
        self._place(starts.spread(pool, spread, self._number(particles), self._key(), each=True))
        self._everywhere = COMPARISONS

    def _look_at_start(self, pose: np.ndarray) -> None:
        """Warn of a start that cannot be meant."""
        grids = [sensor.model.grid for sensor in self._sensors if hasattr(sensor.model, "grid")]
        if grids:
            (place,), (rows, cols) = grids[0].world_to_cells(pose[None, :2]), grids[0].shape
            look_at_start(pose, bool(0 <= place[0] <= cols and 0 <= place[1] <= rows), grids[0].bounds())
        else:
            look_at_heading("start", float(pose[2]))

    def _number(self, particles: int | None) -> int:
        most = self.options.most
        return most if particles is None else checks.integer("particles", particles, low=1, high=most)

    def _place(self, poses: np.ndarray, *, again: bool = False) -> None:
        """Replace all particles, and forget the likelihood of scans.

        Args:
            poses: (N, 3) poses.
            again: Whether a search is repeated: readings, judgements of poses and a pending motion are kept.
        """
        self._cloud.place(poses)
        self._shown, self._started, self._wide, self._together = len(poses), True, 0, False
        if not again:
            self._pending, self._last, self._everywhere = None, {}, 0
            if self._rival is not None:
                self._rival.stop()
            self._verdict.reset()
            for sensor in self._sensors:
                sensor.restart()
        if self.options.recovery == "augmented" and not self._pool[0]:
            self._set_pool(*starts.free_pool([sensor.model for sensor in self._sensors], None))

    def _set_pool(self, pool: np.ndarray, spread: tuple[float, float, float]) -> None:
        self._cloud.set_pool(pool)
        self._pool = len(pool), spread

    def _key(self) -> tuple[int, int, int]:
        """Return the two words of the seed, and a number of this step."""
        self._step += 1
        return *self.options.words, self._step

    def _random_poses(self, count: int) -> np.ndarray:
        """Return poses anywhere in the free space, the same ones each time; around the particles without a grid."""
        key = (*self.options.words, 0)
        try:
            pool, spread = starts.free_pool([sensor.model for sensor in self._sensors], None)
        except ValueError:
            centre = self._cloud.host_poses(self._cloud.places.shown, self._shown).mean(axis=0)
            pool, spread = centre[None], (10.0, 10.0, math.pi)
        return starts.spread(pool, spread, count, key)
