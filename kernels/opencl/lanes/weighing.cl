// Weights of 8 particles at once: the kernels of weighing.cl on vectors that a processor reads, adds and writes whole.
// Sums of integer weights are exact in any order.
// requires: weighing lanes/elementary

typedef doubles Total_lanes;

doubles eight_at_lanes(global const double *values, const int first, const int end, const double missing) {
    if (end - first >= DOUBLES) return vload8(0, values + first);
    const choices there = (choices)(0, 1, 2, 3, 4, 5, 6, 7) < (long)(end - first);
    const doubles found = load_doubles(values, first, end - first);
    return there ? found : (doubles)missing;
}

// Return 8 numbers, rounded down to integers.
Total_lanes sum_eight_lanes(const doubles numbers) { return floor_lanes(numbers); }

// Return the sum of all lanes.
double sum_of_lanes(const Total_lanes total) { return sum_doubles(total); }

double write_eight_lanes(const doubles weights, const double scale, const double before, global double *weight,
                         global double *ends, const int first, const int end) {
    const doubles whole = floor_lanes(weights * scale);
    const int count = min(DOUBLES, end - first);
    doubles upto;
    double sum = before;
    for (int i = 0; i < DOUBLES; i++) {
        sum += i < count ? ((const double *)&whole)[i] : 0.0;
        ((double *)&upto)[i] = sum;
    }
    store_doubles(weights, weight, first, count);
    store_doubles(upto, ends, first, count);
    return sum;
}

doubles tempered_lanes(const doubles scores, const double largest, const double left) {
    return largest == -INFINITY || left == 0.0 ? (doubles)1.0 : exp_of_lanes(LOWEST * left * (scores - largest));
}

// in lanes: weigh_particles set_weights
