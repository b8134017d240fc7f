// Cosine and sine of 8 headings in float64: cos_sin of heading.cl for headings of at most LARGEST_HEADING.
// requires: heading lanes/doubles

// Return the rounded sum of two numbers, and its error.
doubles two_sum_float64_lanes(const doubles a, const doubles b, doubles *error) {
    const doubles sum = a + b, shift = sum - a;
    *error = (a - (sum - shift)) + (b - shift);
    return sum;
}

// Compute the cosines and sines of headings.
void cos_sin_lanes(const doubles theta, doubles *cosines, doubles *sines) {
    const doubles turns = theta * TWO_OVER_PI + ROUNDER, count = turns - ROUNDER;
    const choices quadrant = as_long8(turns) & 3;
    doubles first_low, second_low, low;
    const doubles first = two_sum_float64_lanes(theta - count * QUARTER_1, -(count * QUARTER_2), &first_low);
    const doubles second = two_sum_float64_lanes(first, -(count * QUARTER_3), &second_low);
    const doubles r = two_sum_float64_lanes(second, (first_low + second_low) - count * QUARTER_4, &low);
    const doubles z = r * r;
    const doubles half_z = 0.5 * z;
    const doubles s = S0 + z * (S1 + z * (S2 + z * (S3 + z * (S4 + z * S5))));
    const doubles c = C0 + z * (C1 + z * (C2 + z * (C3 + z * (C4 + z * C5))));
    const doubles sine = r + (r * z * s + low * (1.0 - half_z));
    const doubles near = 1.0 - half_z;
    const doubles cosine = near + (((1.0 - near) - half_z) + (z * z * c - r * low));
    const choices odd = (quadrant & 1) != 0;
    const doubles x = odd ? sine : cosine, y = odd ? cosine : sine;
    *cosines = ((quadrant + 1) & 2) != 0 ? -x : x;
    *sines = (quadrant & 2) != 0 ? -y : y;
}
