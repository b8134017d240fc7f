"""Layout of a feature of landmark and line models: FEATURE numbers, in the same order on the host and in kernels."""

from __future__ import annotations

# Range; cosine and sine of the bearing on the robot; signature.
RANGE_AT, RANGE_LOW, COSINE, SINE, COSINE_LOW, SINE_LOW, SIGNATURE_AT, SIGNATURE_LOW = range(8)
# 1 / (sigma sqrt 2), 0 for components that were not measured; logs of z_detect and the components' peaks, of the false
# positive.
RANGE_SCALE, RANGE_SCALE_LOW, BEARING_SCALE, BEARING_SCALE_LOW, SIGNATURE_SCALE, SIGNATURE_SCALE_LOW = range(8, 14)
PEAK, PEAK_LOW, FALSE_POSITIVE = 14, 15, 16
# Angle from the bearing to the upper end of the field of view.
UPPER, UPPER_LOW = 17, 18
# Only landmarks within RADIUS of the point REACH along the bearing, and no nearer than HOLE, have a density that is not
# negligible; RADIUS is negative where none has.
REACH, RADIUS, HOLE = 19, 20, 21
# The sensor's limits for components that a feature does not measure: distance, and cosine of the angle to the axis.
FARTHEST, AXIS = 22, 23
# sigma sqrt 2 of range and bearing, infinite for components that were not measured; the log of the largest possible
# density; and the largest error of squared distances.
RANGE_SPREAD, BEARING_SPREAD, MOST, SLACK = 24, 25, 26, 27
# Features of one group have different landmarks in a joint association; features of two groups may share one.
GROUP = 28
FEATURE = 29

# A line has its distance and the direction of its normal in place of range and bearing, and in other places: the
# factor of the angle in the second exponent, and the places of its ends along it, from the foot of the normal [m].
MIXED_SCALE, MIXED_SCALE_LOW, FIRST_END, LAST_END = SIGNATURE_SCALE, SIGNATURE_SCALE_LOW, UPPER, UPPER_LOW

# Angles: i / 8, a quarter and half a turn, as sums of two float64 numbers.
ARC_STEPS = 8
ARCS = (
    (0.0, 0.0),
    (0.12435499454676144, -3.1253241424539383e-18),
    (0.24497866312686414, 1.0698755618734451e-17),
    (0.35877067027057225, -2.4623815582638635e-17),
    (0.4636476090008061, 2.2698777452961687e-17),
    (0.5585993153435624, -5.4556305485916264e-18),
    (0.6435011087932844, 1.5834785051444286e-17),
    (0.7188299996216245, -2.1478388444456983e-17),
    (0.7853981633974483, 3.061616997868383e-17),
    (1.5707963267948966, 6.123233995736766e-17),
    (3.141592653589793, 1.2246467991473532e-16),
)
