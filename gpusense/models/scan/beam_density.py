"""The density of a beam model: parameters for each bin of angles of incidence, or the table of a sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpusense._util import checks
from gpusense.models.arguments import check_absent
from gpusense.world.parameters import BeamParameters, IncidenceParameters
from gpusense.world.sensor_table import SensorTable

# Between 1, the largest cosine, and 2, which kernels use for a ray without a return.
_BEYOND = 1.5


@dataclass(frozen=True)
class BeamDensity:
    """The density of a beam model."""

    mixtures: tuple[BeamParameters, ...]  # parameters of each bin in the kernels' order, first for beams without a hit
    cosines: np.ndarray  # cosines between the bins
    incidence: IncidenceParameters | None = None  # the parameters by angle of incidence, or None
    table: SensorTable | None = None  # the table of a sensor in place of the mixtures, or None

    @property
    def parameters(self) -> BeamParameters | SensorTable | None:
        """The mixture, or the table of a sensor; None where parameters depend on the angle of incidence."""
        if self.incidence is not None:
            return None
        return self.mixtures[0] if self.table is None else self.table

    @property
    def max_depends(self) -> bool:
        """Return whether the probability of a max reading depends on the pose."""
        return self.table is not None or len({p.z_max for p in self.mixtures}) > 1

    @property
    def z_max(self) -> float:
        """Largest probability of a max reading; 1 for a table."""
        return max(p.z_max for p in self.mixtures) if self.table is None else 1.0

    @property
    def possible(self) -> bool:
        """Return whether ranges can be possible.

        If ``max_depends``, the kernel detects impossible ranges.
        """
        return self.max_depends or any(p.z_hit or p.z_short or p.z_rand for p in self.mixtures)


def density_of(parameters: object, default: BeamParameters, incidence: object, **options: object) -> BeamDensity:
    """Return the density that the arguments of a beam model choose.

    ``parameters``: the mixture, the table of a sensor, or None; ``default``: the mixture without ``parameters``;
    ``incidence``: parameters by angle of incidence, or None; ``options``: options that must be None with ``incidence``.
    """
    table = parameters if isinstance(parameters, SensorTable) else None
    # A table of a sensor replaces the mixture.
    mixture = default if parameters is None or table else parameters
    if not isinstance(mixture, BeamParameters):
        rule = "must be BeamParameters or a DiscreteBeamModel"
        raise TypeError(f"parameters: {rule}, got {checks.show(parameters)}")
    if incidence is None:
        return BeamDensity((mixture,), np.zeros(1), table=table)
    bins = checks.instance("incidence", incidence, IncidenceParameters)
    check_absent("with incidence", parameters=parameters, **options)
    cosines = np.cos(bins.edges[1:])
    if bins.no_surface is None:
        return BeamDensity(bins.parameters, cosines, bins)
    return BeamDensity((bins.no_surface, *bins.parameters), np.append(_BEYOND, cosines), bins)
