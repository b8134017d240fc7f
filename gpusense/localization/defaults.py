"""Define the defaults of localisation for filter, motion model and commands; the docs list them in a table."""

from __future__ import annotations

from typing import NamedTuple


class Defaults(NamedTuple):
    """Options of a particle filter; ``docs/localization.md`` describes the measurements behind them."""

    particles: int = 2000
    particles_everywhere: int = 20_000  # number of particles for a start anywhere on a map
    beams: int | None = None  # beams per scan in commands; None for all
    threshold: float = 0.5  # resample below this share of the particles
    stages: int = 4  # most stages of a correction
    share: float = 0.1  # least effective sample size of a stage, as a share of concentrated particles
    enough: int = 500  # sufficient effective sample size of a stage, for any number of concentrated particles
    # Least share for spread-out particles, and among landmarks, so that no peak wins by chance.
    share_apart: float = 0.2
    jitter: float = 0.2  # jitter of a drawn particle between stages, as a factor of the difference of two particles
    farthest: float = 1.0  # largest such difference [m]
    farthest_turn: float = 0.5  # largest such difference of headings [rad]
    wide_scans: int = 5  # corrections after a start anywhere on the map that use a lower temperature
    wide_share: float = 0.3  # factor of that temperature, since spread-out particles must be judged less precisely
    slow: float = 0.02  # rate of the slow average of the likelihood
    fast: float = 0.3  # rate of the fast average
    most_injected: float = 0.2  # largest share of injected particles
    recovery: str = "sensor"
    temperature: str = "auto"
    calibrations: int = 60  # number of first corrections that all teach the temperature; later two in 25 do
    alpha: tuple[float, float, float, float] = (0.02, 0.02, 0.02, 0.02)  # noise of the odometry
    reverse: float = 0.02  # probability that a translation went the other direction
    least: tuple[float, float] = (0.01, 0.005)  # least deviations of a step [m, rad]
    sideways: float = 0.02  # variance of sideways slips per squared turn [m^2/rad^2]
    # Deviations of a start at a known pose: x, y [m] and heading [rad].
    start: tuple[float, float, float] = (0.5, 0.5, 0.26)


DEFAULTS = Defaults()
