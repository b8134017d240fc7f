// Exponential and logarithm of 8 numbers in float64: those of elementary.cl.
// requires: elementary lanes/doubles

// 1.5 * 2^52 and its bits: a sum with it has an integer, of either sign, in its last bits.
#define SIGNED_INTEGERS 6755399441055744.0
#define SIGNED_BITS 0x4338000000000000L

// Return exp(x) for x <= 700; 0 below LEAST_EXPONENT.
doubles exp_of_lanes(const doubles x) {
    const doubles held = x > LEAST_EXPONENT ? x : (doubles)0.0;
    const doubles shifted = held * INVERSE_LOG2 + SIGNED_INTEGERS, count = shifted - SIGNED_INTEGERS;
    const doubles r = (held - count * LOG2_HIGH) - count * LOG2_LOW;
    const doubles high = ((((EXP_0 * r + EXP_1) * r + EXP_2) * r + EXP_3) * r + EXP_4) * r + EXP_5;
    const doubles series = (((((high * r + EXP_6) * r + EXP_7) * r + EXP_8) * r + EXP_9) * r + EXP_10) * r + EXP_11;
    const doubles power = as_double8(((as_long8(shifted) - SIGNED_BITS) + 1023) << 52);
    return x > LEAST_EXPONENT ? (1.0 + (r + r * r * series)) * power : (doubles)0.0;
}

// Return the power series of the logarithm.
doubles odd_series_lanes(const doubles z) {
    const doubles high = (((ODD_0 * z + ODD_1) * z + ODD_2) * z + ODD_3) * z + ODD_4;
    return (((((high * z + ODD_5) * z + ODD_6) * z + ODD_7) * z + ODD_8) * z + ODD_9) * z + ODD_10;
}

// Return log(x) of normal numbers x > 0.
doubles log_of_lanes(const doubles x) {
    const long8 bits = as_long8(x);
    const doubles m = as_double8((bits & 0xFFFFFFFFFFFFFL) | 0x3FE0000000000000L);
    const choices small = m < SQRT_HALF;
    const doubles whole = as_double8(((bits >> 52) - 1023) + SIGNED_BITS) - SIGNED_INTEGERS;
    const doubles exponent = whole + (small ? (doubles)0.0 : (doubles)1.0), scaled = small ? 2.0 * m : m;
    const doubles s = (scaled - 1.0) / (scaled + 1.0), z = s * s, series = odd_series_lanes(z);
    return exponent * LOG2_HIGH + (2.0 * s + (2.0 * s * z * series + exponent * LOG2_LOW));
}
