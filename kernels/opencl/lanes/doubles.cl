// Vectors of float64 in which the kernels of particle filters compute 8 particles at once. Their operations are those of
// the scalar kernels, one by one, so the bits are the same; comparisons and masks stand in for calls.
// requires: lanes/types

typedef double8 doubles;
typedef long8 choices;
#define DOUBLES 8
// 2^52 and its bits: a sum of it and an integer below has the integer in its last bits.
#define INTEGERS 4503599627370496.0
#define INTEGER_BITS 0x4330000000000000UL

// Return x rounded down, for x >= 0.
doubles floor_lanes(const doubles x) {
    const doubles nearest = (x + INTEGERS) - INTEGERS, below = nearest > x ? nearest - 1.0 : nearest;
    return x < INTEGERS ? below : x;
}

// Return the sum of all lanes; exact for integers whose sum is below 2^53.
double sum_doubles(const doubles a) {
    const double4 four = a.lo + a.hi;
    const double2 two = four.lo + four.hi;
    return two.x + two.y;
}

// Read numbers of a filter's poses from place on, stride apart; a lane beyond the last of count repeats it.
doubles load_doubles(global const double *numbers, const long place, const int stride, const int count) {
    doubles found;
    for (int i = 0; i < DOUBLES; i++) ((double *)&found)[i] = numbers[place + stride * (i < count ? i : count - 1)];
    return found;
}
