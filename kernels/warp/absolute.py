"""Densities of absolute sensors, which measure a position in the plane or a heading."""

import warp as wp

from gpusense.interface.constants import NEARBY, NEGLIGIBLE, SERIES, VON_MISES, WAVES, WRAPS

from .error_free import pair_product, pair_sum, two_sum
from .flags import FLOAT64, RAND
from .log_terms import bounded_square, either, log_one_plus
from .prelude import kernel
from .types import real, vec2

# sin x = x + x z (SINE[0] + SINE[1] z + ...) with z = x^2, its power series.
SINE = (
    -0.16666666666666666, 0.008333333333333333, -0.0001984126984126984, 2.7557319223985893e-06,
    -2.505210838544172e-08, 1.6059043836821613e-10, -7.647163731819816e-13, 2.8114572543455206e-15,
    -8.22063524662433e-18, 1.9572941063391263e-20,
)  # fmt: skip
ZERO, HALF, ONE, TWO = real(0.0), real(0.5), real(1.0), real(2.0)
HALF_TURN = real(3.141592653589793)
HALF_TURN_LOW = real(0.0 if FLOAT64 else -8.742277657347586e-08)
FAR = real(NEGLIGIBLE)
S0, S1, S2, S3, S4, S5, S6, S7, S8, S9 = (real(term) for term in SINE)


@wp.func
def half_sine(residual: vec2):
    """Return sin(r / 2) of an angle in [-pi, pi]."""
    x = HALF * residual.x
    z = x * x
    higher = S5 + z * (S6 + z * (S7 + z * (S8 + z * S9)))
    series = S0 + z * (S1 + z * (S2 + z * (S3 + z * (S4 + z * higher))))
    return two_sum(x, HALF * residual.y + x * (z * series))


@wp.func
def log_other_turns(residual: vec2, decay: real):
    """Return the log of the ratio of the sum over all turns to the normal of the nearest turn."""
    size = wp.abs(residual.x)
    low = residual.y
    if residual.x < ZERO:
        low = -low
    rest = wp.max((HALF_TURN - size) + (HALF_TURN_LOW - low), ZERO)
    others = real(0.0)
    k = int(1)
    # For most headings the other turns add nothing.
    if decay * rest > FAR:
        k = WRAPS + 1
    while k <= WRAPS:
        turns = real(k)
        others += wp.exp(-decay * turns * ((turns - ONE) * HALF_TURN + rest))
        others += wp.exp(-decay * turns * (turns * HALF_TURN + size))
        k += 1
    return log_one_plus(others)


@wp.func
def log_waves(residual: vec2, waves: wp.array(dtype=real)):
    """Return the log of the ratio of the Fourier series to its first term, by Clenshaw's recurrence."""
    sine = half_sine(residual)
    cosine = ONE - TWO * sine.x * sine.x
    newer = real(0.0)
    older = real(0.0)
    n = WAVES
    while n > 0:
        following = waves[n - 1] + TWO * cosine * newer - older
        older = newer
        newer = following
        n -= 1
    return log_one_plus(cosine * newer - older)


@kernel
def score_position(place, terms, log_p, particles, temperature):
    """Score positions: one work-item takes a particle."""
    n = wp.tid()
    if n >= particles:
        return
    sensor = place[n]
    x = vec2(sensor.x, sensor.y)
    y = vec2(sensor.z, sensor.w)
    first = bounded_square(pair_product(x, vec2(terms[0].x_scale, terms[0].x_scale_low)))
    y_scaled = pair_product(y, vec2(terms[0].y_scale, terms[0].y_scale_low))
    mixed = pair_sum(pair_product(x, vec2(terms[0].shear, terms[0].shear_low)), y_scaled)
    exponent = pair_sum(first, bounded_square(mixed))
    log_density = (terms[0].peak - exponent.x) + (terms[0].peak_low - exponent.y)
    if RAND:
        log_density = either(log_density, terms[0].random)
    log_p[n] = temperature * log_density


@kernel
def score_heading(residual, terms, waves, log_p, particles, kind, temperature):
    """Score headings: one work-item takes a particle. Residuals are headings minus the reading, in [-pi, pi]."""
    n = wp.tid()
    if n >= particles:
        return
    r = residual[n]
    log_density = real(0.0)
    if kind == SERIES:
        log_density = terms[0].peak + (terms[0].peak_low + log_waves(r, waves))
    else:
        root = r
        if kind == VON_MISES:
            root = half_sine(r)
        exponent = bounded_square(pair_product(root, vec2(terms[0].scale, terms[0].scale_low)))
        log_density = (terms[0].peak - exponent.x) + (terms[0].peak_low - exponent.y)
        if kind == NEARBY:
            log_density += log_other_turns(r, terms[0].decay)
    if RAND:
        log_density = either(log_density, terms[0].random)
    log_p[n] = temperature * log_density
