// The density of one reading from a table of log p over bins of readings and expected ranges, instead of a formula.
// Row i is a bin of readings; column j a bin of expected ranges, and the last column is for rays without an obstacle.
// requires: ray

// Bin of a range; what is at the end or beyond belongs to the last one.
int range_bin(const real range, const real per_metre, const int cells) {
    const int bin = (int)(range * per_metre);
    return bin < cells ? bin : cells - 1;
}

real tabulated_density(const real z, const real expected, global const real *sensor, const int cells,
                       const real per_metre, const real range_max) {
    const int column = expected >= range_max ? cells : range_bin(expected, per_metre, cells);
    return sensor[(long)range_bin(z, per_metre, cells) * (cells + 1) + column];
}
