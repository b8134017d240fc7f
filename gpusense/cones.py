"""How a sensor hears: along one ray or in a cone of them, from surfaces at any angle or only from those met head-on."""

from __future__ import annotations

from dataclasses import dataclass

from gpusense.casters import Caster


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


def require_exact(argument: str, method: Caster) -> None:
    """Refuse casters that do not say in which cell a ray ends.

    Raises:
        ValueError: the caster is not exact.
    """
    if not method.exact:
        raise ValueError(f"{argument}: must be an exact one where angles of incidence matter, got {method.name!r}")


LASER = Cones()
