// Densities of LANES readings from a table: sensor_table.cl in lanes.
// requires: lanes/types

ilanes range_bin_lanes(const lanes range, const MixtureTables tables, const real range_max) {
    // Missing readings (NaN) are in no cell either.
    const ilanes below = range < range_max, bin = to_ilanes((below ? range : (lanes)0) * tables.per_metre);
    const ilanes within = bin < tables.cells ? bin : (ilanes)(tables.cells - 1);
    return below ? within : (ilanes)tables.cells;
}

lanes tabulated_density_lanes(const lanes z, const lanes expected, global const real *sensor,
                              const MixtureTables tables, const real range_max) {
    const ilanes column = range_bin_lanes(expected, tables, range_max);
    const ilanes at = range_bin_lanes(z, tables, range_max) * (tables.cells + 1) + column;
    return GATHER(lanes, sensor, at);
}
