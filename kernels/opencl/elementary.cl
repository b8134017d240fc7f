// Exponential, logarithm and angle in float64 from +, -, *, / and sqrt alone, so that every device gives the same bits.
// exp x = 2^k exp r with r = x - k log 2, |r| <= log(2) / 2, by its power series. log x = e log 2 + 2 artanh s with x =
// m 2^e, sqrt(1/2) <= m < sqrt 2 and s = (m - 1) / (m + 1). atan t with t <= 1 is 4 atan t'', where t' = t / (1 + sqrt(1
// + t^2)) halves the angle. Errors are a few units in the last place.

#define LOG2_HIGH 0.6931471803691238
#define LOG2_LOW 1.9082149292705877e-10
#define INVERSE_LOG2 1.4426950408889634
// 1.5 * 2^52 and its bits: a sum with it has an integer, of either sign, in its last bits.
#define SIGNED_INTEGERS 6755399441055744.0
#define SIGNED_BITS 0x4338000000000000L
// Below this exponent the result is 0.
#define LEAST_EXPONENT -700.0
#define SQRT_HALF 0.7071067811865476
#define RIGHT_ANGLE 1.5707963267948966
#define HALF_TURN 3.141592653589793
// 1 / n! for n = 13, ..., 2, and 1 / (2 n + 1) for n = 11, ..., 1.
#define EXP_0 1.6059043836821613e-10
#define EXP_1 2.08767569878681e-09
#define EXP_2 2.505210838544172e-08
#define EXP_3 2.755731922398589e-07
#define EXP_4 2.7557319223985893e-06
#define EXP_5 2.48015873015873e-05
#define EXP_6 0.0001984126984126984
#define EXP_7 0.001388888888888889
#define EXP_8 0.008333333333333333
#define EXP_9 0.041666666666666664
#define EXP_10 0.16666666666666666
#define EXP_11 0.5
#define ODD_0 0.043478260869565216
#define ODD_1 0.047619047619047616
#define ODD_2 0.05263157894736842
#define ODD_3 0.058823529411764705
#define ODD_4 0.06666666666666667
#define ODD_5 0.07692307692307693
#define ODD_6 0.09090909090909091
#define ODD_7 0.1111111111111111
#define ODD_8 0.14285714285714285
#define ODD_9 0.2
#define ODD_10 0.3333333333333333

// Return exp(x) for x <= 700; 0 below LEAST_EXPONENT.
double exp_of(const double x) {
    const double held = x > LEAST_EXPONENT ? x : 0.0;
    const double shifted = held * INVERSE_LOG2 + SIGNED_INTEGERS, count = shifted - SIGNED_INTEGERS;
    const double r = (held - count * LOG2_HIGH) - count * LOG2_LOW;
    const double high = ((((EXP_0 * r + EXP_1) * r + EXP_2) * r + EXP_3) * r + EXP_4) * r + EXP_5;
    const double series = (((((high * r + EXP_6) * r + EXP_7) * r + EXP_8) * r + EXP_9) * r + EXP_10) * r + EXP_11;
    const double power = as_double(((as_long(shifted) - SIGNED_BITS) + 1023) << 52);
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
    const double whole = as_double(((bits >> 52) - 1023) + SIGNED_BITS) - SIGNED_INTEGERS;
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
    angle = size_y > size_x ? RIGHT_ANGLE - angle : angle;
    angle = x < 0.0 ? HALF_TURN - angle : angle;
    return y < 0.0 ? -angle : angle;
}
