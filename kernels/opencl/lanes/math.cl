// Exponentials, logarithms, the error function and the arc tangent in lanes. PoCL's functions are calls that pass
// vectors through memory; only float64 uses them. With |r| <= log(2) / 2 and 1 + f from sqrt(1/2) to sqrt(2):
//     e^a = 2^k e^r,  e^r = 1 + r + r^2 E(r);   log(2^k (1 + f)) = k log 2 + f - f^2 / 2 + f^3 L(f);
//     erf(x) = 1 - exp(-x W(x));   log erfc(x) = -x V(x);   arctan t = t + t^3 A(t^2).
// bench/derive/lane_constants.py derives the constants, those of E, L, A, W and V are in constants.py; tests/kernels/test_lane_math.py measures the worst errors that
// stand below, in ulps of float32.
// requires: lanes/types

#if FLOAT64
// From here on the error function is 1 to the last bit.
#define LANE_ERF_ONE 6.0
// Below this number 1 - e^a is a plain difference.
#define SERIES_END -0.25

// Return e^a for a <= 0.
lanes exp_lanes(const lanes a) { return exp(a); }

// Return 1 - e^a for a <= 0, within 5 ulp: near 0, where the difference would cancel, by the series to a^13 / 13!.
// PoCL's expm1 is a call, and takes longer.
lanes one_minus_exp_lanes(const lanes a) {
    const lanes z = a * a;
    const lanes high = 1.0 / 362880 + z * (1.0 / 39916800 + z * (1.0 / 6227020800));
    const lanes odd = 1.0 / 6 + z * (1.0 / 120 + z * (1.0 / 5040 + z * high));
    const lanes even = 0.5 + z * (1.0 / 24 + z * (1.0 / 720 + z * (1.0 / 40320 + z * (1.0 / 3628800 + z * (1.0 / 479001600)))));
    return a < SERIES_END ? 1 - exp(a) : -(a + z * (even + a * odd));
}

// Return log(p) for p > 0.
lanes log_lanes(const lanes p) { return log(p); }

// Return erf(x) for x >= 0.
lanes erf_lanes(const lanes x) { return any_lane(x < LANE_ERF_ONE) ? erf(x) : (lanes)1; }
#else
// log 2 in two parts; the first has 16 bits, so that its products with counts are exact.
#define LOG2_HIGH 0.693145752f
#define LOG2_LOW 1.42860677e-06f
#define ONE_OVER_LOG2 1.44269502f
// 1.5 * 2^23: a sum with it is rounded to a whole number, held in its last bits.
#define LANE_ROUNDER 12582912.0f
// e^EXP_ZERO is close to the smallest normal number; e^EXP_LOST is below half of the last bit of 1.
#define EXP_ZERO -87.0f
#define EXP_LOST -20.0f
// Bits of sqrt(1/2).
#define ROOT_HALF 0x3f3504f3
// From here on the error function is 1 to the last bit.
#define LANE_ERF_ONE 4.0f

// Return e^r - 1 and the count k of e^a. Polynomials are summed in pairs, which processors compute side by side.
lanes reduced_exp_lanes(const lanes a, ilanes *count) {
    const lanes shifted = a * ONE_OVER_LOG2 + LANE_ROUNDER, k = shifted - LANE_ROUNDER;
    const lanes r = (a - k * LOG2_HIGH) - k * LOG2_LOW, square = r * r;
    *count = as_ilanes(shifted) - as_int(LANE_ROUNDER);
    return r + square * ((E0 + E1 * r) + square * ((E2 + E3 * r) + square * E4));
}

// Return e^a for a <= 0, within 1.1 ulp. Denormal results become 0: processors compute slowly with them.
lanes exp_lanes(const lanes a) {
    ilanes k;
    const lanes rest = reduced_exp_lanes(a, &k), power = (1.0f + rest) * as_lanes((k + 127) << 23);
    return a < EXP_ZERO ? (lanes)0 : power;
}

// Return 1 - e^a for a <= 0, within 1.1 ulp. Nothing cancels: where the count is 0, so is the first term.
lanes one_minus_exp_lanes(const lanes a) {
    ilanes k;
    const lanes rest = reduced_exp_lanes(a < EXP_LOST ? (lanes)EXP_LOST : a, &k), scale = as_lanes((k + 127) << 23);
    return (1.0f - scale) - scale * rest;
}

// Return log(p) of a finite normal number p > 0, within 0.9 ulp.
lanes log_lanes(const lanes p) {
    const ilanes above = as_ilanes(p) - ROOT_HALF;
    const lanes k = to_lanes(above >> 23), f = as_lanes((above & 0x7fffff) + ROOT_HALF) - 1.0f, square = f * f;
    const lanes low = (L0 + L1 * f) + square * (L2 + L3 * f), high = (L4 + L5 * f) + square * (L6 + L7 * f);
    const lanes cubic = (square * f) * (low + (square * square) * high);
    return (f + ((cubic + k * LOG2_LOW) - 0.5f * square)) + k * LOG2_HIGH;
}

// Return arctan t - t for |t| <= tan(pi/8).
lanes arc_rest_lanes(const lanes t) {
    const lanes z = t * t;
    return t * z * ((A0 + A1 * z) + z * z * ((A2 + A3 * z) + z * z * A4));
}

// Return erf(x) for x >= 0, within 3.8 ulp; exactly 1 from 4 on.
lanes erf_lanes(const lanes x) {
    if (!any_lane(x < LANE_ERF_ONE)) return (lanes)1.0f;
    const lanes b = x < LANE_ERF_ONE ? x : (lanes)LANE_ERF_ONE;
    const lanes square = b * b, low = (W0 + W1 * b) + square * (W2 + W3 * b);
    const lanes high = (W4 + W5 * b) + square * ((W6 + W7 * b) + square * W8);
    return one_minus_exp_lanes(-b * (low + (square * square) * high));
}

// Return log(erfc(x)) for 0 <= x <= 4, within 2 eps (1 + |log(erfc(x) / 2)|).
lanes log_erfc_lanes(const lanes x) {
    const lanes square = x * x, low = (V0 + V1 * x) + square * (V2 + V3 * x);
    const lanes high = (V4 + V5 * x) + square * ((V6 + V7 * x) + square * (V8 + V9 * x));
    return -x * (low + (square * square) * high);
}
#endif

// Return log(1 + x) for x > -1; the rounding error of 1 + x is corrected to first order.
lanes log1p_lanes(const lanes x) {
    const lanes sum = 1 + x;
    return log_lanes(sum) + (x - (sum - 1)) / sum;
}
