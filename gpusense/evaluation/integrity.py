"""Integrity of a localiser with a known truth: did its radius bound the error, and did it alert in time?

The classes come from the Stanford diagram. A pose is *available* if its radius is at most the alert limit. An
available pose is *misleading* if its error exceeds the radius but not the alert limit, and *hazardously misleading* if
it exceeds the alert limit (Joerger and others, "Integrity monitoring of localization systems", *Sensors* 18(8), 2018,
2740).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense._util.typing import AnyArray, Floats


@dataclass(frozen=True, eq=False)
class Integrity:
    """Integrity of N poses.

    Attributes:
        errors: (N,) errors of the position [m].
        radii: (N,) radii of protection [m].
        alert_limit: Largest error that is safe [m].
        times: (N,) times [s].

    Example:
        >>> import gpusense as gs
        >>> found = gs.integrity([0.1, 0.4, 3.0, 3.0], [0.3, 0.3, 0.3, 9.0], alert_limit=0.5)
        >>> found.available, found.misleading, found.hazardous, found.times_to_alert.tolist()
        (0.75, 0.25, 0.25, [1.0])
    """

    errors: Floats
    radii: Floats
    alert_limit: float
    times: Floats

    def __repr__(self) -> str:
        return (
            f"Integrity({len(self.errors)} poses, alert_limit={self.alert_limit:g}, available={self.available:.3g}, "
            f"misleading={self.misleading:.3g}, hazardous={self.hazardous:.3g})"
        )

    @property
    def _is_available(self) -> NDArray[np.bool]:
        return self.radii <= self.alert_limit

    @property
    def available(self) -> float:
        """Share of the poses whose radius is at most the alert limit."""
        return float(np.mean(self._is_available))

    @property
    def misleading(self) -> float:
        """Share of the poses that are available, and whose error exceeds the radius but not the alert limit."""
        return float(np.mean(self._is_available & (self.errors > self.radii) & (self.errors <= self.alert_limit)))

    @property
    def hazardous(self) -> float:
        """Share of the poses that are available although the error exceeds the alert limit."""
        return float(np.mean(self._is_available & (self.errors > self.alert_limit)))

    @property
    def exceeded(self) -> float:
        """Share of the poses whose error exceeds the radius, which the risk bounds."""
        return float(np.mean(self.errors > self.radii))

    @property
    def times_to_alert(self) -> Floats:
        """Time from each begin of an error above the alert limit to a radius above it [s]; infinite without an alert.

        An alert that precedes the error counts as 0.
        """
        wrong = self.errors > self.alert_limit
        edges = np.diff(np.concatenate([[False], wrong, [False]]).astype(int))
        found = []
        for first, end in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True):
            alerts = np.flatnonzero(~self._is_available[first:end])
            found.append(self.times[first + alerts[0]] - self.times[first] if len(alerts) else math.inf)
        return np.array(found, np.float64)


def integrity(errors: AnyArray, radii: AnyArray, *, alert_limit: float, times: AnyArray | None = None) -> Integrity:
    """Compare errors with the radii that were promised.

    Args:
        errors: (N,) errors of the position [m], >= 0.
        radii: (N,) radii, such as from ``protection_level(risk)`` [m]; infinite where no radius is promised.
        alert_limit: Largest error that is safe [m], > 0.
        times: (N,) increasing times [s]; None for the numbers of the poses.

    Raises:
        TypeError, ValueError: An argument breaks its rule.

    Example:
        >>> import gpusense as gs
        >>> gs.integrity([0.1, 0.2], [0.3, float("inf")], alert_limit=0.5).available
        0.5
    """
    off = checks.array("errors", errors, ("N",))
    if not len(off) or (off < 0).any():
        raise ValueError(f"errors: must be at least one number >= 0, got {checks.show(off)}")
    promised = checks.array("radii", radii, (len(off),), finite=False)
    if np.isnan(promised).any() or (promised < 0).any():
        raise ValueError(f"radii: must be numbers >= 0, got {checks.show(promised)}")
    at = np.arange(len(off), dtype=np.float64) if times is None else checks.array("times", times, (len(off),))
    if not (np.diff(at) > 0).all():
        raise ValueError("times: must increase, got times that do not")
    return Integrity(off, promised, checks.real("alert_limit", alert_limit, above=0), at)
