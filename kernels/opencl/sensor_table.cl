// Density of one reading from a table of log p over bins of readings and expected ranges; see the reference.
// requires: ray

// Return the bin of a range; the last one, after the cells, is for range_max and more.
int range_bin(const real range, const real per_metre, const int cells, const real range_max) {
    if (range >= range_max) return cells;
    const int bin = (int)(range * per_metre);
    return bin < cells ? bin : cells - 1;
}

// Return log p of a reading for an expected range.
real tabulated_density(const real z, const real expected, global const real *sensor, const MixtureTables tables,
                       const real range_max) {
    const int column = range_bin(expected, tables.per_metre, tables.cells, range_max);
    return sensor[(long)range_bin(z, tables.per_metre, tables.cells, range_max) * (tables.cells + 1) + column];
}
