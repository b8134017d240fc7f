"""Cones of a sensor: one or several rays, with returns at any angle of incidence or only up to a limit."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

from gpusense._util import checks
from gpusense.interface import structs
from gpusense.interface.flags import flags_if
from gpusense.tables.casters import Caster
from gpusense.world.scanner import Scanner


@dataclass(frozen=True)
class Cones:
    """Cones of a sensor."""

    rays: int = 1  # rays of each cone; 1 for a laser
    critical: float = 0.0  # least cosine of an angle of incidence at which a surface returns; 0 without a limit
    incidence: bool = False  # true if angles of incidence are computed, not ranges

    @property
    def struct(self) -> structs.Cone:
        """The cone as kernels take it."""
        return structs.Cone(self.rays, self.critical)

    @functools.cached_property
    def flags(self) -> frozenset[str]:
        """The kernels' flags."""
        incidence = self.incidence or self.critical > 0
        return flags_if(CONES=incidence or self.rays > 1, INCIDENCE=incidence)

    def words(self, critical: float | None) -> str:
        """Return the words of a plan's title; ``critical`` is the largest angle that returns [rad]."""
        cone = f", cones of {self.rays} rays" if self.rays > 1 else ""
        return cone + (f", no return beyond {critical:g} rad of incidence" if critical is not None else "")


def cones_of(scanner: Scanner, method: Caster, *, incidence: bool) -> Cones:
    """Return the cones of a scanner; ``incidence`` says whether its model depends on angles of incidence."""
    critical = scanner.critical_incidence
    least = 0.0 if critical is None or critical >= math.pi / 2 else max(math.cos(critical), 0.0)
    if critical is not None and not method.exact:
        value = f"critical_incidence = {checks.show(critical)}"
        raise ValueError(f"caster: must be an exact one for a scanner with {value}, got {method.name!r}")
    if incidence:
        require_exact("caster", method)
    return Cones(scanner.cone_rays, least, incidence)


def require_exact(argument: str, method: Caster) -> None:
    """Refuse casters that do not find the cell in which a ray ends."""
    if not method.exact:
        raise ValueError(f"{argument}: must be an exact one where angles of incidence matter, got {method.name!r}")


LASER = Cones()
