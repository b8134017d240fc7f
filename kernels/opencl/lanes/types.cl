// Vector types of the kernels in this folder: one work-item computes LANES particles, beams or pairs at once. They are
// for processors whose compilers make no vector code of scalar kernels. The loads of several vectors overlap where a
// processor's vectors are shorter than LANES. A function in lanes has the name of its scalar one and the ending _lanes.
// There are 16 lanes of float32, or 8 of float64.
// PoCL compiles any, fabs, fmax, min and max as calls, too slow for an inner loop: comparisons and masks replace them.

// A density that were a call would pass vectors through memory, and load all constants again.
#define INLINE inline __attribute__((always_inline))

// Numbers at two places, with indices in memory that are not negative and share a load.
#define AT_TWO(table, i, n) table[(uint)((const ulong *)(i))[n]], table[((const ulong *)(i))[n] >> 32]

// Return whether a comparison of 8 numbers of float64 holds in any lane.
int any_of_lanes(const long8 holds) {
    const long4 four = holds.lo | holds.hi;
    const long2 two = four.lo | four.hi;
    return (two.x | two.y) != 0;
}

#if FLOAT64
typedef double8 lanes;
typedef long8 ilanes;
typedef long lane_int;
#define LANES 8
#define as_ilanes as_long8
#define as_lanes as_double8
#define any_lane any_of_lanes
#define load_lanes vload8
#define store_lanes vstore8
#define GATHER(type, table, i)                                                                                           \
    ((type)(table[i.s0], table[i.s1], table[i.s2], table[i.s3], table[i.s4], table[i.s5], table[i.s6], table[i.s7]))
#define GATHER_AT(type, table, i)                                                                                        \
    ((type)(table[i[0]], table[i[1]], table[i[2]], table[i[3]], table[i[4]], table[i[5]], table[i[6]], table[i[7]]))
#define GATHER_BY_TWO(type, table, i)                                                                                    \
    ((type)(AT_TWO(table, i, 0), AT_TWO(table, i, 1), AT_TWO(table, i, 2), AT_TWO(table, i, 3)))
// Number and next one at half of the places.
#define PAIRS(table, i)                                                                                                  \
    ((lanes)(vload2(0, table + i[0]), vload2(0, table + i[1]), vload2(0, table + i[2]), vload2(0, table + i[3])))
// 1.5 * 2^52 and its bits: a sum of it and an integer has the integer in its last bits. Not every processor converts
// vectors of 64 bits.
#define LANE_INTEGERS 6755399441055744.0
#define LANE_INTEGER_BITS 0x4338000000000000L

// Convert integers below 2^51.
lanes to_lanes(const ilanes i) { return as_lanes(i + LANE_INTEGER_BITS) - LANE_INTEGERS; }

// Round down; truncate to an integer numbers that are not negative.
ilanes to_ilanes(const lanes a) {
    const lanes shifted = a + LANE_INTEGERS;
    return as_ilanes(shifted) - LANE_INTEGER_BITS + (shifted - LANE_INTEGERS > a);
}

// Return the sum of all lanes.
real sum_lanes(const lanes a) {
    const double4 four = a.lo + a.hi;
    const double2 two = four.lo + four.hi;
    return two.x + two.y;
}
#else
typedef float16 lanes;
typedef int16 ilanes;
typedef int lane_int;
#define LANES 16
#define to_lanes convert_float16
#define to_ilanes convert_int16_rtz
#define as_ilanes as_int16
#define as_lanes as_float16
#define load_lanes vload16
#define store_lanes vstore16
#define GATHER(type, table, i)                                                                                           \
    ((type)(table[i.s0], table[i.s1], table[i.s2], table[i.s3], table[i.s4], table[i.s5], table[i.s6], table[i.s7],      \
            table[i.s8], table[i.s9], table[i.sa], table[i.sb], table[i.sc], table[i.sd], table[i.se], table[i.sf]))
// GATHER with indices in memory: faster where they were computed well before.
#define GATHER_AT(type, table, i)                                                                                        \
    ((type)(table[i[0]], table[i[1]], table[i[2]], table[i[3]], table[i[4]], table[i[5]], table[i[6]], table[i[7]],      \
            table[i[8]], table[i[9]], table[i[10]], table[i[11]], table[i[12]], table[i[13]], table[i[14]], table[i[15]]))
// GATHER_AT with half the loads of indices: faster where nothing else reads them.
#define GATHER_BY_TWO(type, table, i)                                                                                    \
    ((type)(AT_TWO(table, i, 0), AT_TWO(table, i, 1), AT_TWO(table, i, 2), AT_TWO(table, i, 3), AT_TWO(table, i, 4),     \
            AT_TWO(table, i, 5), AT_TWO(table, i, 6), AT_TWO(table, i, 7)))
// Number and next one at half of the places, each pair by one load.
#define PAIR(table, at) as_long(vload2(0, table + at))
#define PAIRS(table, i)                                                                                                  \
    as_float16((long8)(PAIR(table, i[0]), PAIR(table, i[1]), PAIR(table, i[2]), PAIR(table, i[3]), PAIR(table, i[4]),    \
                       PAIR(table, i[5]), PAIR(table, i[6]), PAIR(table, i[7])))

// Return whether a comparison holds in any lane.
int any_lane(const ilanes holds) {
    const int8 eight = holds.lo | holds.hi;
    const long2 two = as_long2(eight.lo | eight.hi);
    return (two.x | two.y) != 0;
}

// Return the sum of all lanes.
real sum_lanes(const lanes a) {
    const float8 eight = a.lo + a.hi;
    const float4 four = eight.lo + eight.hi;
    const float2 two = four.lo + four.hi;
    return two.x + two.y;
}

// Return the bits of the absolute values; as integers they have the order of the values.
ilanes size_bits(const lanes a) { return as_ilanes(a) & 0x7fffffff; }
#endif

// Round down.
ilanes floor_int_lanes(const lanes a) {
    const ilanes whole = to_ilanes(a);
    return whole + (to_lanes(whole) > a);
}

// Read a number and the next one at each of LANES places.
void gather_pairs(global const real *numbers, const lane_int *at, lanes *first, lanes *second) {
    const lanes low = PAIRS(numbers, at), high = PAIRS(numbers, (at + LANES / 2));
    *first = (lanes)(low.even, high.even);
    *second = (lanes)(low.odd, high.odd);
}

// Return the vector of numbers in memory, the last of count standing in for those beyond it.
lanes load_some(global const real *numbers, const int count) {
    if (count >= LANES) return load_lanes(0, numbers);
    real some[LANES];
    for (int i = 0; i < LANES; ++i) some[i] = numbers[min(i, count - 1)];
    return load_lanes(0, some);
}

// Write the first count lanes, all of them where count is larger.
void store_some(const lanes values, global real *numbers, const int count) {
    if (count >= LANES) {
        store_lanes(values, 0, numbers);
        return;
    }
    for (int i = 0; i < count; ++i) numbers[i] = ((const real *)&values)[i];
}
