// Straight segments of scans: pieces of the sequence of points that a line explains up to the noise of ranges; see the
// reference. Rows are added by Givens rotations, which avoid cancellation in costs.

// Passes of merging and of moving ends; Gauss-Newton steps of a line.
#define PASSES 2
#define STEPS 5
// A segment with a larger cost per point is split at its best point, even if a single split does not pay.
#define POOR ((real)3)
// Rows count as parallel up to this sine.
#define PARALLEL ((real)1e-6)
// Splits whose costs differ by less than this share, which exceeds float32 rounding, are tied: the first counts.
#define TIED ((real)3e-7)

// The triangular root of rows that were added, the right-hand side, and the cost.
typedef struct {
    real r11, r12, z1, r22, z2, cost;
} Rows;

// Return the median of three numbers.
real middle_of_three(const real a, const real b, const real c) {
    return fmax(fmin(a, b), fmin(fmax(a, b), c));
}

// Return the weight of the row (x, y, 1) of point i; its range is the median of three neighbours.
real weight_at(global const real4 *point, const int i, const int first, const int last, const real sigma) {
    const real r = point[i].w;
    const real middle = middle_of_three(point[max(i - 1, first)].w, r, point[min(i + 1, last - 1)].w);
    return middle * middle / (sigma * r);
}

// Add a row (a, b | v).
void add_row(Rows *rows, real a, real b, real v) {
    real size = sqrt(rows->r11 * rows->r11 + a * a);
    const real largest = fabs(b) + fabs(rows->r12);
    if (size > 0) {
        const real c = rows->r11 / size, s = a / size, r12 = rows->r12, z1 = rows->z1;
        rows->r11 = size;
        rows->r12 = c * r12 + s * b;
        rows->z1 = c * z1 + s * v;
        b = c * b - s * r12;
        v = c * v - s * z1;
    }
    size = sqrt(rows->r22 * rows->r22 + b * b);
    if (size > PARALLEL * largest) {
        const real c = rows->r22 / size, s = b / size, z2 = rows->z2;
        rows->r22 = size;
        rows->z2 = c * z2 + s * v;
        v = c * v - s * z2;
    }
    rows->cost += v * v;
}

// Return the cost of a line through points first to last.
real cost_of(global const real4 *point, const int first, const int last, const real sigma) {
    Rows rows = {0, 0, 0, 0, 0, 0};
    for (int i = first; i < last; ++i) {
        const real weight = weight_at(point, i, first, last, sigma);
        add_row(&rows, weight * point[i].x, weight * point[i].y, weight);
    }
    return rows.cost;
}

// Return the first point of the second line of the best split, the cost reduction, and the unsplit cost. The point is
// -1 if no split can lower the cost by penalty.
int best_split(global const real4 *point, const int first, const int last, global real *cost, const real sigma,
               const real penalty, real *gain, real *total) {
    Rows rows = {0, 0, 0, 0, 0, 0};
    for (int i = first; i < last; ++i) {
        const real weight = weight_at(point, i, first, last, sigma);
        add_row(&rows, weight * point[i].x, weight * point[i].y, weight);
        cost[i] = rows.cost;
    }
    *total = rows.cost;
    *gain = 0;
    if (*total <= penalty) return -1;
    rows.r11 = rows.r12 = rows.z1 = rows.r22 = rows.z2 = rows.cost = 0;
    for (int i = last - 1; i > first; --i) {
        const real weight = weight_at(point, i, first, last, sigma);
        add_row(&rows, weight * point[i].x, weight * point[i].y, weight);
        // From here on cost[i] is the cost that a split before point i saves.
        cost[i] = *total - cost[i - 1] - rows.cost;
        *gain = fmax(*gain, cost[i]);
    }
    int best = first + 1;
    while (best < last - 1 && cost[best] < *gain - TIED * ((real)1e5 + *total)) ++best;
    *gain = cost[best];
    return best;
}

// Return whether something may be hidden between point k and the one before.
int is_apart(global const real4 *point, const int k, const real gap) {
    return point[k].z - point[k - 1].z > gap;
}

// Split a scan: each segment's first point gets its end, all other points -1.
void split_scan(global const real4 *point, const int first, const int last, global real *cost, global int *stop,
                const real sigma, const real penalty, const real gap) {
    int begin = first;
    for (int k = first + 1; k <= last; ++k) {
        if (k < last) stop[k] = -1;
        if (k == last || is_apart(point, k, gap)) {
            stop[begin] = k;
            begin = k;
        }
    }
    int i = first;
    while (i < last) {
        real gain, total;
        const int end = stop[i], k = best_split(point, i, end, cost, sigma, penalty, &gain, &total);
        if (k >= 0 && (gain > penalty || total > POOR * (real)(end - i) + penalty)) {
            stop[k] = end;
            stop[i] = k;
        } else {
            i = end;
        }
    }
}

// Merge neighbours that a single line fits at an extra cost below penalty.
void merge_segments(global const real4 *point, const int first, const int last, global int *stop, const real sigma,
                    const real penalty, const real gap) {
    int i = first;
    while (i < last && stop[i] < last) {
        const int j = stop[i], end = stop[j];
        real whole = penalty;
        if (!is_apart(point, j, gap))
            whole = cost_of(point, i, end, sigma) - cost_of(point, i, j, sigma) - cost_of(point, j, end, sigma);
        if (whole < penalty) {
            stop[i] = end;
            stop[j] = -1;
        } else {
            i = j;
        }
    }
}

// Move the ends between neighbours to where both lines cost least.
void move_ends(global const real4 *point, const int first, const int last, global real *cost, global int *stop,
               const real sigma, const real penalty, const real gap) {
    int i = first;
    while (i < last && stop[i] < last) {
        int j = stop[i];
        const int end = stop[j];
        real gain, total;
        const int k = is_apart(point, j, gap) ? -1 : best_split(point, i, end, cost, sigma, penalty, &gain, &total);
        if (k >= 0) {
            stop[j] = -1;
            stop[k] = end;
            stop[i] = k;
            j = k;
        }
        i = j;
    }
}

// Write a, b, the triangular root of the information about (a, b), and the cost of a line through a part of a scan: -1
// where no line fits, all 0 for two points.
void fit_line(global const real4 *point, const int begin, const int size, const int first, const int count,
              const real sigma, global real *line) {
    for (int i = 0; i < LINE_NUMBERS; ++i) line[i] = 0;
    if (count < 3) return;
    real a = 0, b = 0;
    for (int step = 0; step <= STEPS + 1; ++step) {
        Rows rows = {0, 0, 0, 0, 0, 0};
        real cost = 0;
        int good = 1;
        for (int k = 0; k < count; ++k) {
            const real4 p = point[begin + (first - begin + k) % size];
            const real c = p.x / p.w, s = p.y / p.w, expected = 1 / (a * c + b * s);
            if (step == 0) {
                const real weight = p.w * p.w / sigma;
                add_row(&rows, weight * c, weight * s, weight / p.w);
            } else {
                const real weight = expected * expected / sigma, error = (p.w - expected) / sigma;
                good = good && expected > 0;
                cost += error * error;
                add_row(&rows, -weight * c, -weight * s, error);
            }
        }
        if (!good) {
            line[0] = a;
            line[1] = b;
            line[2] = line[3] = line[4] = 0;
            line[5] = -1;
            return;
        }
        line[2] = rows.r11;
        line[3] = rows.r12;
        line[4] = rows.r22;
        line[5] = cost;
        if (step <= STEPS) {
            const real second = rows.r22 != 0 ? rows.z2 / rows.r22 : 0;
            const real change = (rows.z1 - rows.r12 * second) / rows.r11;
            a += change;
            b += second;
        }
    }
    line[0] = a;
    line[1] = b;
}

// Split scans into segments: stop is the end of the segment that begins at a point, -1 at all other points. One
// work-item takes a scan.
kernel void split_scans(ARGUMENTS) {
    const int scan = get_global_id(0);
    if (scan >= scans) return;
    const int first = start[scan], last = start[scan + 1];
    const real sigma = noise[scan];
    if (last == first) return;
    split_scan(point, first, last, cost, stop, sigma, penalty, gap);
    for (int pass = 0; pass < PASSES; ++pass) {
        merge_segments(point, first, last, stop, sigma, penalty, gap);
        move_ends(point, first, last, cost, stop, sigma, penalty, gap);
    }
    merge_segments(point, first, last, stop, sigma, penalty, gap);
}

// Fit lines to parts of scans: first point and number of points, which may wrap around to the scan's first point. One
// work-item takes a part.
kernel void fit_segments(ARGUMENTS) {
    const int k = get_global_id(0);
    if (k >= parts) return;
    const int begin = start[scan[k]], size = start[scan[k] + 1] - begin;
    fit_line(point, begin, size, part[k].x, part[k].y, noise[scan[k]], line + LINE_NUMBERS * k);
}
