// Cosine and sine of a heading in float64 with +, - and * alone, so that every device gives the same bits; see the
// reference.

// A coordinate or a heading of a pose in memory.
#if POSES_FLOAT32
typedef float coordinate;
#else
typedef double coordinate;
#endif

// Quarter turns modulo 4, and the remaining angle as the sum of two numbers.
typedef struct {
    long quadrant;
    double2 rest;
} Turn;

// two_sum of error_free.cl in float64, whatever the precision of real.
double2 two_sum_float64(const double a, const double b) {
    const double sum = a + b;
    const double shift = sum - a;
    return (double2)(sum, (a - (sum - shift)) + (b - shift));
}

// high_half in float64.
double high_half_float64(const double a) {
    const double scaled = 134217729.0 * a;
    return scaled - (scaled - a);
}

// pair_product in float64.
double2 pair_product_float64(const double2 a, const double2 b) {
    const double product = a.x * b.x;
    const double a_high = high_half_float64(a.x), b_high = high_half_float64(b.x);
    const double a_low = a.x - a_high, b_low = b.x - b_high;
    const double error = ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low;
    return two_sum_float64(product, error + (a.x * b.y + a.y * b.x));
}

// Reduce a heading of at most LARGEST_HEADING.
Turn reduce_ordinary(const double theta) {
    const double turns = theta * TWO_OVER_PI + ROUNDER, count = turns - ROUNDER;
    // The first product and difference are exact, and so are the next two products.
    const double2 first = two_sum_float64(theta - count * QUARTER_1, -(count * QUARTER_2));
    const double2 second = two_sum_float64(first.x, -(count * QUARTER_3));
    const double low = (first.y + second.y) - count * QUARTER_4;
    Turn turn;
    // The last bits of the sum with ROUNDER are the integer.
    turn.quadrant = as_long(turns) & 3;
    turn.rest = two_sum_float64(second.x, low);
    return turn;
}

#if HUGE_HEADINGS
// Reduce a heading above LARGEST_HEADING, up to the largest number.
Turn reduce_huge(const double theta) {
    const ulong bits = as_ulong(fabs(theta));
    const ulong mantissa = (bits & 0xFFFFFFFFFFFFFUL) | 0x10000000000000UL;
    const ulong low_half = mantissa & 0xFFFFFFFFUL, high_half = mantissa >> 32;
    // Bits of 2/pi that contribute whole turns are left out: the window's first bit times the last bit of the mantissa
    // is half a turn.
    const int first = (int)(bits >> 52) - (1075 - 62);
    const int word = first >> 5, shift = first & 31;
    // turns = mantissa * window modulo 2^192, of which the upper four words are kept.
    ulong turn_1 = 0, turn_2 = 0, turn_3 = 0, turn_4 = 0, carry_1 = 0, carry_2 = 0, below = 0;
    for (int k = 5; k >= 0; k--) {
        const ulong words = (ulong)WORDS[word + k] << 32 | WORDS[word + k + 1];
        const ulong digit = words << shift >> 32;
        const ulong sum_1 = low_half * digit + carry_1;
        const ulong sum_2 = high_half * below + (sum_1 & 0xFFFFFFFFUL) + carry_2;
        carry_1 = sum_1 >> 32, carry_2 = sum_2 >> 32, below = digit;
        turn_4 = turn_3, turn_3 = turn_2, turn_2 = turn_1, turn_1 = sum_2 & 0xFFFFFFFFUL;
    }
    // Round to the nearest quarter. The rest, in units of 2^-62 quarters, is cut into pieces that convert without
    // rounding.
    const ulong turn_high = (turn_1 << 32 | turn_2) + 0x2000000000000000UL, turn_low = turn_3 << 32 | turn_4;
    const int quadrant = (int)(turn_high >> 62);
    const long rest = (long)(turn_high & 0x3FFFFFFFFFFFFFFFUL) - 0x2000000000000000L;
    const double piece_1 = (double)(rest >> 30) * 0x1p-32, piece_2 = (double)(rest & 0x3FFFFFFFL) * 0x1p-62;
    const double piece_3 = (double)(turn_low >> 34) * 0x1p-92;
    const double piece_4 = (double)((turn_low >> 4) & 0x3FFFFFFFUL) * 0x1p-122;
    const double2 total = two_sum_float64(piece_1, piece_2);
    const double2 quarters = two_sum_float64(total.x, total.y + (piece_3 + piece_4));
    const double2 angle = pair_product_float64(quarters, (double2)(QUARTER, QUARTER_LOW));
    Turn turn;
    turn.quadrant = (theta < 0 ? -quadrant : quadrant) & 3;
    turn.rest = theta < 0 ? (double2)(-angle.x, -angle.y) : angle;
    return turn;
}
#endif

// Reduce a heading of any size; without HUGE_HEADINGS, of at most LARGEST_HEADING.
Turn reduce_heading(const double theta) {
#if HUGE_HEADINGS
    return fabs(theta) <= LARGEST_HEADING ? reduce_ordinary(theta) : reduce_huge(theta);
#else
    return reduce_ordinary(theta);
#endif
}

// Return (cosine, sine) of a reduced heading.
double2 cos_sin_of(const Turn turn) {
    const double r = turn.rest.x, low = turn.rest.y;
    const double z = r * r;
    const double half_z = 0.5 * z;
    const double s = S_0 + z * (S_1 + z * (S_2 + z * (S_3 + z * (S_4 + z * S_5))));
    const double c = C_0 + z * (C_1 + z * (C_2 + z * (C_3 + z * (C_4 + z * C_5))));
    const double sine = r + (r * z * s + low * (1.0 - half_z));
    const double near = 1.0 - half_z;
    const double cosine = near + (((1.0 - near) - half_z) + (z * z * c - r * low));
    const long odd = (turn.quadrant & 1) != 0;
    const double x = odd ? sine : cosine, y = odd ? cosine : sine;
    return (double2)(((turn.quadrant + 1) & 2) != 0 ? -x : x, (turn.quadrant & 2) != 0 ? -y : y);
}

// Return (cosine, sine) of a heading; for a heading that is not finite they are meaningless, but not NaN.
double2 cos_sin(const double theta) { return cos_sin_of(reduce_heading(theta)); }
