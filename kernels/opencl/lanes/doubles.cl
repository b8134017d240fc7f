// Vectors of float64 in which the kernels of particle filters compute 8 particles at once. They repeat the operations
// of the scalar kernels in order, so the bits are the same; comparisons and masks replace calls.
// requires: lanes/types

typedef double8 doubles;
typedef long8 choices;
#define DOUBLES 8
// Two numbers in each lane.
typedef struct {
    doubles x, y;
} DoublePair;
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

// Read numbers from place on; a lane beyond the last of count repeats it.
doubles load_doubles(global const double *numbers, const long place, const int count) {
    if (count == DOUBLES) return vload8(0, numbers + place);
    doubles found;
    for (int i = 0; i < DOUBLES; i++) ((double *)&found)[i] = numbers[place + (i < count ? i : count - 1)];
    return found;
}

// Write the first count numbers from place on.
void store_doubles(const doubles values, global double *numbers, const long place, const int count) {
    if (count == DOUBLES) {
        vstore8(values, 0, numbers + place);
        return;
    }
    for (int i = 0; i < count; i++) numbers[place + i] = ((const double *)&values)[i];
}

// Read poses from particle n on; a lane beyond the last of count repeats it.
void load_poses(global const double *poses, const int n, const int count, doubles *x, doubles *y, doubles *theta) {
    global const double *place = poses + 3 * (long)n;
    if (count == DOUBLES) {
        const doubles a = vload8(0, place), b = vload8(1, place), c = vload8(2, place);
        *x = (doubles)(a.s036, b.s147, c.s25), *y = (doubles)(a.s147, b.s25, c.s036);
        *theta = (doubles)(a.s25, b.s036, c.s147);
        return;
    }
    for (int i = 0; i < DOUBLES; i++) {
        global const double *one = place + 3 * (i < count ? i : count - 1);
        ((double *)x)[i] = one[0], ((double *)y)[i] = one[1], ((double *)theta)[i] = one[2];
    }
}

// Write the first count poses from particle n on.
void store_poses(const doubles x, const doubles y, const doubles theta, global double *poses, const int n,
                 const int count) {
    global double *place = poses + 3 * (long)n;
    if (count == DOUBLES) {
        vstore8((doubles)(x.s0, y.s0, theta.s0, x.s1, y.s1, theta.s1, x.s2, y.s2), 0, place);
        vstore8((doubles)(theta.s2, x.s3, y.s3, theta.s3, x.s4, y.s4, theta.s4, x.s5), 1, place);
        vstore8((doubles)(y.s5, theta.s5, x.s6, y.s6, theta.s6, x.s7, y.s7, theta.s7), 2, place);
        return;
    }
    for (int i = 0; i < count; i++) {
        place[3 * i] = ((const double *)&x)[i], place[3 * i + 1] = ((const double *)&y)[i];
        place[3 * i + 2] = ((const double *)&theta)[i];
    }
}
