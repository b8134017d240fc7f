// Cosine and sine of a heading in float64 with +, - and * alone, so that every device gives the same bits. A heading is
// reduced to r + low, |r| <= pi/4, and a count of quarter turns modulo 4: up to 2^20 rad by subtracting the count times
// pi/2 in four parts (Cody and Waite), for larger headings by an integer product with the relevant bits of 2/pi (Payne
// and Hanek). Then sin r = r + r z S(z) and cos r = 1 - z/2 + z^2 C(z) with z = r^2. bench/derive/heading_constants.py
// derives the constants.

// Up to this heading the counts of quarter turns have 20 bits.
#define LARGEST_HEADING 1048576.0
#define TWO_OVER_PI 0.6366197723675814
// 1.5 * 2^52: adding it rounds to an integer.
#define ROUNDER 6755399441055744.0
// pi/2 in three parts of 33 bits and a rounded one, and as the sum of two rounded numbers.
#define QUARTER_1 1.5707963267341256
#define QUARTER_2 6.077100506303966e-11
#define QUARTER_3 2.0222662487111665e-21
#define QUARTER_4 8.4784276603689e-32
#define QUARTER 1.5707963267948966
#define QUARTER_LOW 6.123233995736766e-17
// S and C, lowest power first; their relative errors are 2^-56.4 and 2^-59.6.
#define S0 -0.1666666666666663
#define S1 0.008333333333322118
#define S2 -0.00019841269829589585
#define S3 2.7557313621399067e-06
#define S4 -2.505074776451535e-08
#define S5 1.5896230233207278e-10
#define C0 0.041666666666666595
#define C1 -0.0013888888888873056
#define C2 2.4801587288851755e-05
#define C3 -2.7557314179308847e-07
#define C4 2.087570084339475e-09
#define C5 -1.1358536585312173e-11
#if HUGE_HEADINGS
// The bits of 2/pi in words of 32 after two words of zeros.
constant uint WORDS[39] = {
    0x00000000, 0x00000000, 0xA2F9836E, 0x4E441529, 0xFC2757D1, 0xF534DDC0, 0xDB629599, 0x3C439041, 0xFE5163AB,
    0xDEBBC561, 0xB7246E3A, 0x424DD2E0, 0x06492EEA, 0x09D1921C, 0xFE1DEB1C, 0xB129A73E, 0xE88235F5, 0x2EBB4484,
    0xE99C7026, 0xB45F7E41, 0x3991D639, 0x835339F4, 0x9C845F8B, 0xBDF9283B, 0x1FF897FF, 0xDE05980F, 0xEF2F118B,
    0x5A0A6D1F, 0x6D367ECF, 0x27CB09B7, 0x4F463F66, 0x9E5FEA2D, 0x7527BAC7, 0xEBE5F17B, 0x3D0739F7, 0x8A5292EA,
    0x6BFB5FB1, 0x1F8D5D08, 0x56033046,
};
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

// Return (cosine, sine) of a reduced heading.
double2 cos_sin_of(const Turn turn) {
    const double r = turn.rest.x, low = turn.rest.y;
    const double z = r * r;
    const double half_z = 0.5 * z;
    const double s = S0 + z * (S1 + z * (S2 + z * (S3 + z * (S4 + z * S5))));
    const double c = C0 + z * (C1 + z * (C2 + z * (C3 + z * (C4 + z * C5))));
    const double sine = r + (r * z * s + low * (1.0 - half_z));
    const double near = 1.0 - half_z;
    const double cosine = near + (((1.0 - near) - half_z) + (z * z * c - r * low));
    const long odd = (turn.quadrant & 1) != 0;
    const double x = odd ? sine : cosine, y = odd ? cosine : sine;
    return (double2)(((turn.quadrant + 1) & 2) != 0 ? -x : x, (turn.quadrant & 2) != 0 ? -y : y);
}

// Return (cosine, sine) of a heading; for a heading that is not finite they are meaningless, but not NaN.
double2 cos_sin(const double theta) {
#if HUGE_HEADINGS
    return cos_sin_of(fabs(theta) <= LARGEST_HEADING ? reduce_ordinary(theta) : reduce_huge(theta));
#else
    return cos_sin_of(reduce_ordinary(theta));
#endif
}
