// Cosine and sine of 8 headings of at most LARGEST_HEADING, in float64.
// requires: heading lanes/doubles

// in lanes: two_sum_float64 Turn reduce_ordinary cos_sin_of

// Return (cosines, sines) of headings.
DoublePair cos_sin_lanes(const doubles theta) { return cos_sin_of_lanes(reduce_ordinary_lanes(theta)); }
