// Readings drawn from the beam model, or from a table of a sensor, given their expected ranges; see the reference.
// requires: philox sensor_table

#define DRAW_CELLS 1024
#define DRAW_PER_LOG 27.0
#define DRAW_POWERS 8

// Return numbers in (0, 1) from two words, the centres of 2^52 intervals.
double fine_uniform(const uint high, const uint low) {
    return (((double)high * HALF_WORD + (double)(low >> 12)) + 0.5) * FINE;
}

// Return the mass of the standard normal between 0 and x >= 0.
double half_mass(const double x) {
    if (x >= HALF_FROM) return 0.5;
    if (x >= SERIES_END) {
        double fraction = x;
        for (int n = FRACTION_TERMS; n > 0; --n) fraction = x + (double)n / fraction;
        return 0.5 - NORMAL_PEAK * exp_of(-0.5 * x * x) / fraction;
    }
    const double square = x * x;
    double term = 1.0, total = 1.0;
    for (int n = 1; n < SERIES_TERMS; ++n) {
        term = term * (square / (2.0 * (double)n + 1.0));
        total = total + term;
    }
    return x * (NORMAL_PEAK * exp_of(-0.5 * square)) * total;
}

// Return a polynomial by Horner's rule, the highest power first.
double polynomial(constant double *factor, const double x) {
    double value = factor[0];
    for (int i = 1; i < 8; ++i) value = value * x + factor[i];
    return value;
}

// Return the x >= 0 with a mass of the standard normal between 0 and x, from 0 to MOST_HALF.
double half_quantile(const double mass) {
    if (mass <= CENTRAL) {
        const double r = CENTRAL_OFFSET - mass * mass;
        return mass * (polynomial(CENTRAL_OVER, r) / polynomial(CENTRAL_UNDER, r));
    }
    const double root = sqrt(-log_of(0.5 - mass));
    if (root <= CENTRAL_END) {
        const double r = root - OUTER_OFFSET;
        return polynomial(OUTER_OVER, r) / polynomial(OUTER_UNDER, r);
    }
    const double r = root - OUTERMOST_OFFSET;
    return polynomial(OUTERMOST_OVER, r) / polynomial(OUTERMOST_UNDER, r);
}

// Return a standard normal deviate between -low <= 0 and high >= 0.
double normal_within(const double u, const double low, const double high) {
    const double below = half_mass(low), above = half_mass(high);
    const double mark = u * (below + above) - below;
    const double size = half_quantile(fmin(fabs(mark), MOST_HALF));
    return fmin(fmax(mark < 0.0 ? -size : size, -low), high);
}

// Return the number of a table at a logarithmic coordinate.
double tabulated(const double at, global const double *table) {
    const double steps = at * DRAW_PER_LOG;
    const int cell = (int)fmin(steps, DRAW_CELLS - 1.0);
    const double share = steps - (double)cell;
    global const double *number = table + cell * DRAW_POWERS;
    double value = number[DRAW_POWERS - 1];
    for (int i = DRAW_POWERS - 2; i >= 0; --i) value = value * share + number[i];
    return value;
}

// Return the mass of a hit between its mean and a distance of u scales, from its table.
double table_mass(const double u, global const double *table) {
    return fmin(tabulated(log_of(1.0 + fmin(u, FARTHEST_HIT) * SQRT_HALF), table), 0.5);
}

// Return a deviate of a hit between -low <= 0 and high >= 0, from its tables.
double table_within(const double u, const double low, const double high, global const double *tables) {
    const double below = table_mass(low, tables), above = table_mass(high, tables);
    const double mark = u * (below + above) - below;
    const double level = -log_of(1.0 - 2.0 * fmin(fabs(mark), MOST_HALF));
    const double size = (exp_of(tabulated(level, tables + DRAW_CELLS * DRAW_POWERS)) - 1.0) / SQRT_HALF;
    return fmin(fmax(mark < 0.0 ? -size : size, -low), high);
}

// Return a range drawn from p_short, up to the expected range (> 0).
double short_of(const double u, const double expected, const double decay) {
    const double x = decay * expected;
    if (x < SHORT_SERIES) {
        const double square = u * u;
        const double bend = (u / 6.0 - square / 2.0) + square * u / 3.0;
        return fmin(expected * (u + x * ((square - u) / 2.0 + x * bend)), expected);
    }
    return fmin(-log_of((1.0 - u) + u * exp_of(-x)) / decay, expected);
}

// Return a reading drawn from the mixture; infinity without return, NaN where no reading is possible.
double reading_of(const double u, const double v, const double expected, global const double *mixture, const int bins,
                  const double range_max) {
    global const double *p = mixture + DRAW_TERMS * bins;
    const double first = p[0], second = first + (expected > 0.0 ? p[1] : 0.0), third = second + p[2];
    const double total = third + p[3], mark = u * total;
    if (!(total > 0.0)) return (double)NAN;
    if (mark < first) {
        const double mean = fmin(fmax(expected + p[6], 0.0), range_max), spread = p[4] + p[5] * expected;
#if MASS_TABLE
        const double off = table_within(v, mean / spread, (range_max - mean) / spread, mixture + (int)p[8]);
#else
        const double off = normal_within(v, mean / spread, (range_max - mean) / spread);
#endif
        return fmax(mean + spread * off, 0.0);
    }
    if (mark < second) return short_of(v, expected, p[7]);
    return mark < third ? (double)INFINITY : v * range_max;
}

// Return a reading drawn from a table: uniform in a drawn bin, at a margin from the bin's ends.
double cell_reading_of(const double u, const double v, const int column, global const double *chances, const int cells,
                       const double range_max, const double margin) {
    global const double *row = chances + (long)column * (cells + 1);
    const double mark = u * row[cells];
    int low = 0, high = cells;
    while (low < high) {
        const int middle = (low + high) / 2;
        if (row[middle] > mark) {
            high = middle;
        } else {
            low = middle + 1;
        }
    }
    if (low == cells) return (double)INFINITY;
    return ((double)low + (margin + v * (1.0 - 2.0 * margin))) * (range_max / (double)cells);
}

// Replace expected ranges by readings; incidence holds cosines, and edges the cosines between bins. One work-item takes
// a particle and ray.
kernel void draw_readings(ARGUMENTS) {
    const int k = get_global_id(0), i = get_global_id(1);
    if (k >= rays || i >= particles) return;
    const long place = (long)i * rays + k, n = (long)settings[DRAW_FIRST] + i, each = (long)settings[DRAW_PER_SCAN];
    const uint step = (uint)(n / each) + (uint)settings[DRAW_STEP];
    const uint4 words = random_words((uint4)((uint)(n % each), step, READING_STREAM + (uint)k, 0),
                                     (uint)settings[DRAW_SEED], (uint)settings[DRAW_SEED + 1]);
    const double u = fine_uniform(words.x, words.y), v = fine_uniform(words.z, words.w);
    const double limit = settings[DRAW_RANGE_MAX];
#if SENSOR_TABLE
    const int column = range_bin(ranges[place], tables.per_metre, tables.cells, scale.range_max);
    const double drawn = cell_reading_of(u, v, column, chances, tables.cells, limit, settings[DRAW_MARGIN]);
#else
    int bins = 0;
#if INCIDENCE
    while (bins + 1 < tables.incidence_bins && incidence[place] <= edges[bins]) ++bins;
#endif
    const double drawn = reading_of(u, v, fmin((double)ranges[place], limit), mixture, bins, limit);
#endif
    if (isinf(drawn)) {
        ranges[place] = scale.range_max;
    } else {
        ranges[place] = isnan(drawn) ? (real)NAN : (real)fmin(drawn, settings[DRAW_TOP]);
    }
}
