// Offsets between places in sums of two numbers: a relative error of eps in 20 m is too large for a deviation of 1 cm.
// A place is (x, its low part, y, its low part), and so is an offset.
// requires: error_free

// Return the offset from a sensor to a landmark or beacon (x, y, and the low parts of both).
real4 offset(const real4 landmark, const real4 place) {
    const real2 x = two_sum(landmark.x, -place.x), y = two_sum(landmark.y, -place.z);
    return (real4)(two_sum(x.x, x.y + (landmark.z - place.y)), two_sum(y.x, y.y + (landmark.w - place.w)));
}

// Return the length of an offset: the rounded root, and the correction of one step of Newton's method.
real2 distance_pair(const real4 off) {
    const real2 xx = two_product(off.x, off.x), yy = two_product(off.z, off.z), sum = two_sum(xx.x, yy.x);
    const real d = sqrt(sum.x);
    const real2 dd = two_product(d, d);
    const real rest =
        (sum.x - dd.x) + ((sum.y + ((xx.y + yy.y) - dd.y)) + 2 * (off.x * off.y + off.z * off.w));
    return (real2)(d, d > 0 ? rest / (2 * d) : (real)0);
}
