// Exponential, logarithm and angle in float64 from +, -, *, / and sqrt alone, so that every device gives the same bits;
// see the reference.

// The bits of ROUNDER.
#define ROUNDER_BITS 0x4338000000000000L

// Return exp(x) for x <= 700; 0 below LEAST_EXPONENT.
double exp_of(const double x) {
    const double held = x > LEAST_EXPONENT ? x : 0.0;
    const double shifted = held * INVERSE_LOG2 + ROUNDER, count = shifted - ROUNDER;
    const double r = (held - count * LOG2_HIGH) - count * LOG2_LOW;
    const double high = ((((EXP_0 * r + EXP_1) * r + EXP_2) * r + EXP_3) * r + EXP_4) * r + EXP_5;
    const double series = (((((high * r + EXP_6) * r + EXP_7) * r + EXP_8) * r + EXP_9) * r + EXP_10) * r + EXP_11;
    const double power = as_double(((as_long(shifted) - ROUNDER_BITS) + 1023) << 52);
    return x > LEAST_EXPONENT ? (1.0 + (r + r * r * series)) * power : 0.0;
}

// Return the power series of the logarithm and of the angle.
double odd_series(const double z) {
    const double high = (((ODD_0 * z + ODD_1) * z + ODD_2) * z + ODD_3) * z + ODD_4;
    return (((((high * z + ODD_5) * z + ODD_6) * z + ODD_7) * z + ODD_8) * z + ODD_9) * z + ODD_10;
}

// Return log(x) of a normal number x > 0.
double log_of(const double x) {
    const long bits = as_long(x);
    const double m = as_double((bits & 0xFFFFFFFFFFFFFL) | 0x3FE0000000000000L);
    const long small = m < SQRT_HALF;
    const double whole = as_double(((bits >> 52) - 1023) + ROUNDER_BITS) - ROUNDER;
    const double exponent = small ? whole : whole + 1.0, scaled = small ? 2.0 * m : m;
    const double s = (scaled - 1.0) / (scaled + 1.0), z = s * s, series = odd_series(z);
    return exponent * LOG2_HIGH + (2.0 * s + (2.0 * s * z * series + exponent * LOG2_LOW));
}

// Return the angle of a vector in [-pi, pi]; 0 for the vector 0.
double angle_of(const double x, const double y) {
    const double size_x = fabs(x), size_y = fabs(y);
    const double high = size_x > size_y ? size_x : size_y, low = size_x > size_y ? size_y : size_x;
    double t = low / (high > 0.0 ? high : 1.0);
    t = t / (1.0 + sqrt(1.0 + t * t));
    t = t / (1.0 + sqrt(1.0 + t * t));
    const double z = -(t * t);
    const double series = odd_series(z);
    double angle = 4.0 * (t + t * z * series);
    angle = size_y > size_x ? QUARTER - angle : angle;
    angle = x < 0.0 ? HALF_TURN - angle : angle;
    return y < 0.0 ? -angle : angle;
}
