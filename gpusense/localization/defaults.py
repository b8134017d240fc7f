"""Defaults of localisation, shared by the filter, the motion model and the commands; the docs have a table of them."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple


class Defaults(NamedTuple):
    """Options of a particle filter; ``docs/localization.md`` has the measurements behind them.

    Attributes:
        particles: Number of particles.
        particles_everywhere: Number of particles where the filter starts anywhere on a map.
        beams: Beams of a scan that commands use; None for all.
        threshold: Resample below this share of the particles.
        stages: Most stages of a correction.
        share: Least effective sample size of a stage, as a share of the particles, if they lie together.
        enough: Effective sample size that suffices for a stage, for any number of particles that lie together.
        share_apart: Least share if they lie apart, and among landmarks, so that no peak wins by chance.
        jitter: Factor of the difference of two particles by which a drawn particle is jittered between stages.
        farthest: Largest such difference [m].
        farthest_turn: Largest such difference of headings [rad].
        wide_scans: Corrections after a start anywhere on the map that use a lower temperature.
        wide_share: Factor of that temperature, since particles that lie apart must be judged less precisely.
        slow: Rate of the slow average of the likelihood.
        fast: Rate of the fast average.
        most_injected: Largest share of injected particles.
        recovery: Recovery of the filter.
        temperature: Temperature of the filter.
        calibrations: Corrections at the beginning that all teach the temperature; later two of ten do.
        field: Parameters of the likelihood field of ``gpusense localize``.
        alpha: Noise of the odometry.
        reverse: Probability that a translation went the other direction.
        least: Least deviations of a step [m, rad].
        sideways: Variance of slips to the side per squared turn [m^2/rad^2].
        start: Deviations of a start at a known pose: x, y [m] and heading [rad].
    """

    particles: int = 2000
    particles_everywhere: int = 20_000
    beams: int | None = None
    threshold: float = 0.5
    stages: int = 4
    share: float = 0.1
    enough: int = 500
    share_apart: float = 0.2
    jitter: float = 0.2
    farthest: float = 1.0
    farthest_turn: float = 0.5
    wide_scans: int = 5
    wide_share: float = 0.3
    slow: float = 0.02
    fast: float = 0.3
    most_injected: float = 0.2
    recovery: str = "sensor"
    temperature: str = "auto"
    calibrations: int = 60
    field: Mapping[str, Any] = MappingProxyType(
        dict(z_hit=0.7, z_max=0.0, z_rand=0.3, sigma_hit=0.07, interpolation="bilinear")
    )
    alpha: tuple[float, float, float, float] = (0.02, 0.02, 0.02, 0.02)
    reverse: float = 0.02
    least: tuple[float, float] = (0.01, 0.005)
    sideways: float = 0.02
    start: tuple[float, float, float] = (0.5, 0.5, 0.26)


DEFAULTS = Defaults()
