// The look-up table of expected ranges, filled by the exact caster from the centres of cells, some rows at a time.
// requires: raycast

// Fill rows of the table: one work-item takes a bin and cell. A hit is at most 65 534; 65 535 means no hit.
kernel void fill_lookup(ARGUMENTS) {
    const int bin = get_global_id(0), index = get_global_id(1);
    if (bin >= bins || index >= count * window.cols) return;
    const int row = first_row + index / window.cols, col = index % window.cols;
    const real4 pose = (real4)((real)0.5, (real)0.5, ray[bin].x, ray[bin].y);
    const real t = cast_ray(rectangles, window, (int2)(col, row), pose, (real2)(1, 0), limit, (Caster){0, 0, 0});
    const int part = (int)(t * ((real)65535 / limit) + (real)0.5);
    lookup[((long)row * window.cols + col) * bins + bin] = (ushort)(t >= limit ? 65535 : part > 65534 ? 65534 : part);
}
