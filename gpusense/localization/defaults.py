"""Define the defaults of localisation for filter, motion model and commands; the docs list them in a table."""

from __future__ import annotations

from typing import NamedTuple


class Defaults(NamedTuple):
    """Options of a particle filter; ``docs/localization.md`` describes the measurements behind them.

    Attributes:
        particles: Number of particles.
        particles_everywhere: Number of particles for a start anywhere on a map.
        beams: Beams per scan in commands; None for all.
        threshold: Resample below this share of the particles.
        stages: Most stages of a correction.
        share: Least effective sample size of a stage, as a share of concentrated particles.
        enough: Sufficient effective sample size of a stage, for any number of concentrated particles.
        share_apart: Least share for spread-out particles, and among landmarks, so that no peak wins by chance.
        jitter: Jitter of a drawn particle between stages, as a factor of the difference of two particles.
        farthest: Largest such difference [m].
        farthest_turn: Largest such difference of headings [rad].
        wide_scans: Corrections after a start anywhere on the map that use a lower temperature.
        wide_share: Factor of that temperature, since spread-out particles must be judged less precisely.
        slow: Rate of the slow average of the likelihood.
        fast: Rate of the fast average.
        most_injected: Largest share of injected particles.
        recovery: Recovery of the filter.
        temperature: Temperature of the filter.
        calibrations: Number of first corrections that all teach the temperature; later two in 25 do.
        alpha: Noise of the odometry.
        reverse: Probability that a translation went the other direction.
        least: Least deviations of a step [m, rad].
        sideways: Variance of sideways slips per squared turn [m^2/rad^2].
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
    alpha: tuple[float, float, float, float] = (0.02, 0.02, 0.02, 0.02)
    reverse: float = 0.02
    least: tuple[float, float] = (0.01, 0.005)
    sideways: float = 0.02
    start: tuple[float, float, float] = (0.5, 0.5, 0.26)


DEFAULTS = Defaults()
