// Several particles or beams at once in one work-item, in vector types, for processors whose compilers do not make such
// code of scalar kernels. The width is the device's. float32 only.

#if WIDE
#if LANES_16
typedef float16 lanes;
typedef int16 ilanes;
#define LANES 16
#define to_lanes convert_float16
#define to_ilanes convert_int16_rtz
#define load_lanes vload16
#define store_lanes vstore16
#define GATHER(type, table, i)                                                                                           \
    ((type)(table[i.s0], table[i.s1], table[i.s2], table[i.s3], table[i.s4], table[i.s5], table[i.s6], table[i.s7],      \
            table[i.s8], table[i.s9], table[i.sa], table[i.sb], table[i.sc], table[i.sd], table[i.se], table[i.sf]))
#else
typedef float8 lanes;
typedef int8 ilanes;
#define LANES 8
#define to_lanes convert_float8
#define to_ilanes convert_int8_rtz
#define load_lanes vload8
#define store_lanes vstore8
#define GATHER(type, table, i)                                                                                           \
    ((type)(table[i.s0], table[i.s1], table[i.s2], table[i.s3], table[i.s4], table[i.s5], table[i.s6], table[i.s7]))
#endif
#endif
