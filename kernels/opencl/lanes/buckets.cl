// Buckets of landmarks that discs touch: bucket_at of landmark_grid.cl for four places at once.

// Return the first and last column, and the first and last row, of the buckets that discs touch; see bucket_at.
int4 touched_buckets(const real2 x, const real2 y, const float radius, const Buckets buckets) {
    const float4 at = floor((float4)(x.x - radius, x.y + radius, y.x - radius, y.y + radius) / buckets.size);
    const float4 last = (float4)(buckets.cols - 1, buckets.cols - 1, buckets.rows - 1, buckets.rows - 1);
    const float4 least = at > 0 ? at : (float4)0;
    return convert_int4(least < last ? least : last);
}
