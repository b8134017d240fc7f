"""Fit the parameters of a bumper."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, cast

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.typing import Floats, Precision, Space
from gpusense.backends import Selection, get_backend
from gpusense.learning.fitted import PointFit, number_blocks
from gpusense.learning.point.problem import Problem, maximize, mix, of_weight, report
from gpusense.models.point.bumper import BumperModel
from gpusense.world.grid import OccupancyGrid
from gpusense.world.sensor_parameters import BumperParameters

# Deviation for reading gaps off a model [cells]; it gives the widest margin around the map.
_WIDE = 16.0


@dataclass(frozen=True, eq=False)
class _Bumps(Problem):
    """Likelihood of presses by (p_contact, p_false, log sigma)."""

    per_reading: ClassVar[tuple[str, ...]] = ("gaps", "pressed")
    gaps: Floats
    pressed: Floats
    side: float

    def bounds(self) -> list[tuple[float, float]]:
        return [(0.0, 1.0), (0.0, 1.0), (math.log(1e-3 * self.side), math.log(1e3 * self.side))]

    def scales(self, theta: Floats) -> Floats:
        return np.array([of_weight(theta[0]), of_weight(theta[1]), 1.0])

    def starts(self) -> list[Floats]:
        sigmas = self.side * np.array([0.05, 0.2, 0.5, 1.0, 3.0, 10.0])
        return [np.array([contact, false, math.log(sigma)])
                for sigma in sigmas for contact in (0.6, 0.95) for false in (0.01, 0.2)]  # fmt: skip

    def log_p(self, theta: Floats) -> tuple[Floats, Floats]:
        from scipy.special import log_ndtr

        contact, false, sigma = theta[0], theta[1], math.exp(theta[2])
        u = self.gaps / sigma
        touching, clear = log_ndtr(-u), log_ndtr(u)
        yes = self.pressed > 0
        pressed = mix([(contact, touching), (false, clear)])
        released = mix([(1 - contact, touching), (1 - false, clear)])
        log_p = np.where(yes, pressed[0], released[0])
        ratios = [np.where(yes, p, -r) for p, r in zip(pressed[2], released[2], strict=True)]
        # d P(touching) / d log sigma = u phi(u), over p.
        log_slope = -0.5 * u * u - 0.5 * math.log(2 * math.pi) - np.where(np.isfinite(log_p), log_p, -1e300)
        by_sigma = np.where(yes, 1, -1) * (contact - false) * u * np.exp(np.minimum(log_slope, 700.0))
        return log_p, np.stack([ratios[0], ratios[1], by_sigma], axis=1)

    def values(self, theta: Floats) -> dict[str, float]:
        return {"p_contact": float(theta[0]), "p_false": float(theta[1]), "sigma": math.exp(theta[2])}


def fit_bumper_parameters(
    poses: ArrayLike,
    pressed: ArrayLike,
    grid: OccupancyGrid,
    outline: ArrayLike,
    *,
    segments: ArrayLike | None = None,
    unknown: Space = "free",
    outside: Space = "free",
    blocks: ArrayLike | None = None,
    max_iterations: int = 200,
    tolerance: float = 1e-8,
    backend: Selection = "auto",
) -> PointFit[BumperParameters]:
    """Fit the parameters of a bumper to readings at known poses, by maximum likelihood.

    The likelihood is :class:`BumperModel`'s. The model's distances between outline and map are computed on the device,
    the rest on the host.

    Args:
        poses: (F, 3) robot poses (x, y, theta) in the world [m, m, rad].
        pressed: (F,) or, with segments, (F, B) values: 1 or True if pressed, 0 or False if not, NaN if missing.
        grid: The map.
        outline: The robot's outline, as in :class:`BumperModel`.
        segments: The outline's parts, as in :class:`BumperModel`.
        unknown: Treatment of unknown cells: ``"free"`` (the default) or ``"occupied"``.
        outside: Treatment of space outside the grid: ``"free"`` (the default) or ``"occupied"``.
        blocks: None, or (F,) integer labels of poses whose errors are correlated, for standard errors.
        max_iterations: Largest number of iterations of a search.
        tolerance: The search has converged once it expects to gain less than ``tolerance`` [nats].
        backend: The device, see ``gpusense.devices()``; or a queue of pyopencl.

    Returns:
        The fit. Presses far from walls determine p_false, presses well within walls p_contact, presses near the
        surface sigma.

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: A value breaks a rule above, the shapes differ, or there is no reading.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> grid = gs.OccupancyGrid([[0] * 40 + [100] * 10], resolution=0.1)
        >>> poses = np.column_stack([np.linspace(0.5, 4.3, 4000), np.full(4000, 0.05), np.zeros(4000)])
        >>> pressed = np.random.default_rng(0).random(4000) < np.where(poses[:, 0] > 3.7, 0.9, 0.02)
        >>> fit = gs.fit_bumper_parameters(poses, pressed, grid, 0.3, backend="numpy")
        >>> fit.converged, round(fit.parameters.p_contact, 1), round(fit.parameters.p_false, 2)
        (True, 0.9, 0.02)
    """
    checks.instance("grid", grid, OccupancyGrid)
    wide = BumperParameters(p_contact=1.0, p_false=0.0, sigma=_WIDE * grid.resolution)
    precision: Precision = "float64" if get_backend(backend).info.float64 else "float32"
    model = BumperModel(
        grid, outline, wide, segments=segments, backend=backend, precision=precision, unknown=unknown, outside=outside
    )
    pose = checks.array("poses", poses, ("F", 3))
    raw = checks.as_array("pressed", pressed, masked=True)
    shape = (len(pose),) if raw.ndim == 1 and model.segments == 1 else (len(pose), model.segments)
    table = checks.array("pressed", raw.astype(np.float64) if raw.dtype == bool else raw, shape, finite=False)
    table = table.reshape(len(pose), model.segments)
    used = np.isfinite(table)
    if not np.isin(table[used], (0.0, 1.0)).all():
        raise ValueError(f"pressed: every value must be 0, 1 or nan, got {checks.show(table[used].max())}")
    if not used.any():
        raise ValueError(f"pressed: must hold one that is not nan, got {table.size} without")
    numbers = number_blocks(blocks, (len(pose),), np.nonzero(used)[0])
    problem = _Bumps(outline_gaps(model, pose)[used], table[used], grid.resolution)
    end = maximize(problem, max_iterations, tolerance)
    return report(problem, end, BumperParameters(**problem.values(end.theta)), numbers, int((~used).sum()))


def outline_gaps(model: BumperModel, poses: Floats) -> Floats:
    """Return the (F, B) gaps from each segment of the outline to the nearest obstacle, by the model [m].

    If p_contact = 1 and p_false = 0, log p is log Phi(-gap / sigma) for a pressed bumper, else log Phi(gap / sigma).
    The smaller of the two determines the gap precisely.
    """
    from scipy.special import ndtri_exp

    columns = []
    for s in range(model.segments):
        states = np.full(model.segments, math.nan)
        logs = []
        for state in (1.0, 0.0):
            states[s] = state
            log_p = cast(Floats, model.log_likelihood(poses, states))
            logs.append(np.asarray(log_p, np.float64))
        least = ndtri_exp(np.minimum(*logs))
        columns.append(model.parameters.sigma * np.where(logs[0] < logs[1], -least, least))
    return np.stack(columns, axis=1)
