"""How a sensor hears: along one ray or in a cone of them, from surfaces at any angle or only from those met head-on."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gpusense._util import checks
from gpusense.tables.casters import Caster
from gpusense.world.parameters import BeamParameters, IncidenceParameters
from gpusense.world.scanner import Scanner

# Between every cosine and what kernels have for one where nothing returns.
_BEYOND = 1.5


@dataclass(frozen=True)
class Cones:
    """How a sensor hears.

    Attributes:
        rays: Rays of each cone; 1 for a laser.
        critical: Least cosine of an angle of incidence at which a surface returns; 0 where all do.
        incidence: Whether angles of incidence are wanted, not ranges.
    """

    rays: int = 1
    critical: float = 0.0
    incidence: bool = False

    @property
    def scalars(self) -> tuple[int, float]:
        """The kernels' arguments cone_rays and critical."""
        return self.rays, self.critical

    @property
    def flags(self) -> frozenset[str]:
        """The kernels' flags."""
        if self.incidence or self.critical > 0:
            return frozenset({"ECHO", "INCIDENCE"})
        return frozenset({"ECHO"} if self.rays > 1 else ())

    def words(self, critical: float | None) -> str:
        """What a plan's title says of it; ``critical`` is the largest angle that returns [rad]."""
        cone = f", cones of {self.rays} rays" if self.rays > 1 else ""
        return cone + (f", no return beyond {critical:g} rad of incidence" if critical is not None else "")


def cones_of(scanner: Scanner, method: Caster, *, incidence: bool) -> Cones:
    """How a scanner hears; ``incidence`` says whether its model depends on angles of incidence.

    Raises:
        ValueError: angles of incidence matter, and the caster is not exact.
    """
    critical = scanner.critical_incidence
    least = 0.0 if critical is None or critical >= math.pi / 2 else max(math.cos(critical), 0.0)
    if critical is not None and not method.exact:
        value = f"critical_incidence = {checks.show(critical)}"
        raise ValueError(f"caster: must be an exact one for a scanner with {value}, got {method.name!r}")
    if incidence:
        require_exact("caster", method)
    return Cones(scanner.cone_rays, least, incidence)


def bins_of(incidence: IncidenceParameters) -> tuple[tuple[BeamParameters, ...], np.ndarray]:
    """The mixtures in the kernels' order, that of beams that hit nothing first, and the cosines that part them."""
    cosines = np.cos(incidence.edges[1:])
    if incidence.no_surface is None:
        return incidence.parameters, cosines
    return (incidence.no_surface, *incidence.parameters), np.append(_BEYOND, cosines)


def require_exact(argument: str, method: Caster) -> None:
    """Refuse casters that do not say in which cell a ray ends.

    Raises:
        ValueError: the caster is not exact.
    """
    if not method.exact:
        raise ValueError(f"{argument}: must be an exact one where angles of incidence matter, got {method.name!r}")


LASER = Cones()
