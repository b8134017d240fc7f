// Circles through parts of scans: poles, and walls that are round; see the reference.

// Steps of a fit; the first steps, which minimise distances from the circle; the smallest cosine of an angle of
// incidence.
#define CIRCLE_STEPS 25
#define RADIAL_STEPS 8
#define STEEPEST ((real)0.1)
#define WHOLE_TURN ((real)6.283185307179586)

// Points of a part of a scan, its edges, and the deviation of ranges.
typedef struct {
    global const real4 *point;
    int begin, size, first, count;
    real4 edge;
    real sigma;
} Part;

// Cost, gradient, and information of a circle.
typedef struct {
    real cost, x, y, r, xx, xy, xr, yy, yr, rr;
} Sums;

// Return a point of a part, which may wrap around to the scan's first point.
real4 point_of(const Part *mine, const int k) {
    return mine->point[mine->begin + (mine->first - mine->begin + k) % mine->size];
}

// Return an angle in -pi to pi.
real wrapped(const real angle) {
    return angle - WHOLE_TURN * floor(angle / WHOLE_TURN + (real)0.5);
}

// Return centre and radius of the pole between two bearings that has the mean range of some points.
real4 pole_guess(const Part *mine) {
    const real width = (real)0.5 * wrapped(mine->edge.y - mine->edge.x);
    const real sine = sin(fmin(width, (real)1.2)), middle = mine->edge.x + width;
    real sum = 0;
    for (int k = 0; k < mine->count; ++k) sum += point_of(mine, k).w;
    const real distance = sum / (real)mine->count / (1 - (real)0.785 * sine);
    return (real4)(distance * cos(middle), distance * sin(middle), distance * sine, 0);
}

// Return centre and radius by linear least squares (Kasa 1976).
real4 arc_guess(const Part *mine) {
    real2 mean = (real2)(0);
    for (int k = 0; k < mine->count; ++k) mean += point_of(mine, k).xy;
    mean /= (real)mine->count;
    real xx = 0, xy = 0, yy = 0, xs = 0, ys = 0, sum = 0;
    for (int k = 0; k < mine->count; ++k) {
        const real2 d = point_of(mine, k).xy - mean;
        const real square = d.x * d.x + d.y * d.y;
        xx += d.x * d.x;
        xy += d.x * d.y;
        yy += d.y * d.y;
        xs += d.x * square;
        ys += d.y * square;
        sum += square;
    }
    const real whole = xx * yy - xy * xy;
    if (!(whole > 0)) return (real4)(0);
    const real a = (real)0.5 * (yy * xs - xy * ys) / whole, b = (real)0.5 * (xx * ys - xy * xs) / whole;
    return (real4)(mean.x + a, mean.y + b, sqrt(a * a + b * b + sum / (real)mine->count), 0);
}

// Return -1 where beams meet the near side of a circle, as at a pole, and 1 for the far side.
real side_of(const Part *mine, const real4 guess) {
    if (mine->edge.z > 0) return -1;
    real beyond = 0;
    for (int k = 0; k < mine->count; ++k) {
        const real4 p = point_of(mine, k);
        beyond += (p.x * guess.x + p.y * guess.y) / p.w - p.w;
    }
    return beyond < 0 ? 1 : -1;
}

// Add the row of derivatives (a, b, c) and an error.
void add_error(Sums *sums, const real a, const real b, const real c, const real error) {
    sums->cost += error * error;
    sums->x += a * error;
    sums->y += b * error;
    sums->r += c * error;
    sums->xx += a * a;
    sums->xy += a * b;
    sums->xr += a * c;
    sums->yy += b * b;
    sums->yr += b * c;
    sums->rr += c * c;
}

// Add the derivatives and the error of the bearing of an edge, the right one (-1) or the left one (1).
void edge_row(Sums *sums, const real4 circle, const real place, const real deviation, const real side) {
    const real distance = sqrt(circle.x * circle.x + circle.y * circle.y);
    const real sine = fmin(circle.z / distance, (real)0.99), slope = side / sqrt(1 - sine * sine);
    const real error = wrapped(atan2(circle.y, circle.x) + side * asin(sine) - place);
    const real square = distance * distance, inward = slope * circle.z / (square * distance);
    add_error(sums, (-circle.y / square - inward * circle.x) / deviation,
              (circle.x / square - inward * circle.y) / deviation, slope / distance / deviation, error / deviation);
}

// Return the cost of a circle, its gradient and its information. Beams meet its near side (-1) or its far side (1);
// a beam that passes the circle is compared with its nearest point to it. Radial errors are distances from the circle.
Sums circle_sums(const Part *mine, const real side, const real4 circle, const int radial) {
    Sums sums = {0, 0, 0, 0, 0, 0, 0, 0, 0, 0};
    const real sigma = mine->sigma, least = STEEPEST * circle.z * (STEEPEST * circle.z);
    for (int k = 0; k < mine->count; ++k) {
        const real4 p = point_of(mine, k);
        if (radial) {
            const real x = p.x - circle.x, y = p.y - circle.y, far = fmax(sqrt(x * x + y * y), (real)1e-9);
            add_error(&sums, x / far / sigma, y / far / sigma, 1 / sigma, (circle.z - far) / sigma);
        } else {
            const real c = p.x / p.w, s = p.y / p.w, beside = circle.x * s - circle.y * c;
            const real square = circle.z * circle.z - beside * beside;
            const real error = circle.x * c + circle.y * s + side * sqrt(fmax(square, (real)0)) - p.w;
            const real slope = side / sqrt(fmax(square, least));
            add_error(&sums, (c - slope * beside * s) / sigma, (s + slope * beside * c) / sigma,
                      slope * circle.z / sigma, error / sigma);
        }
    }
    if (mine->edge.z > 0) {
        edge_row(&sums, circle, mine->edge.x, mine->edge.z, -1);
        edge_row(&sums, circle, mine->edge.y, mine->edge.w, 1);
    }
    return sums;
}

// Return the step of centre and radius with the diagonal of the information raised.
real4 damped_step(const Sums sums, const real damping) {
    const real xx = sums.xx * (1 + damping), yy = sums.yy * (1 + damping), rr = sums.rr * (1 + damping);
    const real xy = sums.xy, xr = sums.xr, yr = sums.yr;
    const real a = yy * rr - yr * yr, b = xr * yr - xy * rr, c = xy * yr - xr * yy;
    const real d = xx * rr - xr * xr, e = xy * xr - xx * yr, f = xx * yy - xy * xy;
    const real whole = xx * a + xy * b + xr * c;
    if (!(whole > 0)) return (real4)(0);
    return (real4)(-(a * sums.x + b * sums.y + c * sums.r) / whole, -(b * sums.x + d * sums.y + e * sums.r) / whole,
                   -(c * sums.x + e * sums.y + f * sums.r) / whole, 0);
}

// Write centre, radius, cost (-1 where no circle fits) and information of the circle through a part of a scan.
void fit_circle(const Part *mine, global real *result) {
    for (int i = 0; i < CIRCLE_NUMBERS; ++i) result[i] = i == 3 ? -1 : 0;
    const real4 guess = mine->edge.z > 0 ? pole_guess(mine) : arc_guess(mine);
    if (!(guess.z > 0) || !isfinite(guess.x) || !isfinite(guess.y) || !isfinite(guess.z)) return;
    const real side = side_of(mine, guess);
    real4 circle = guess;
    real damping = (real)1e-3;
    Sums sums = circle_sums(mine, side, circle, 1);
    for (int step = 0; step < CIRCLE_STEPS; ++step) {
        const int radial = step < RADIAL_STEPS;
        if (step == RADIAL_STEPS) {
            sums = circle_sums(mine, side, circle, 0);
            damping = (real)1e-3;
        }
        const real4 following = circle + damped_step(sums, damping);
        const Sums better = circle_sums(mine, side, following, radial);
        if (following.z > 0 && better.cost <= sums.cost) {
            circle = following;
            sums = better;
            damping = fmax((real)0.1 * damping, (real)1e-9);
        } else {
            damping *= 10;
        }
    }
    result[0] = circle.x;
    result[1] = circle.y;
    result[2] = circle.z;
    result[3] = sums.cost;
    result[4] = sums.xx;
    result[5] = sums.xy;
    result[6] = sums.xr;
    result[7] = sums.yy;
    result[8] = sums.yr;
    result[9] = sums.rr;
}

// Fit circles to parts of scans, of a first point and a number of points. Edges are the bearings of the right and the
// left edge and their deviations; a deviation of 0 marks an edge that is not seen. One work-item takes a part.
kernel void fit_circles(ARGUMENTS) {
    const int k = get_global_id(0);
    if (k >= parts) return;
    const int begin = start[scan[k]];
    const Part mine = {point, begin, start[scan[k] + 1] - begin, part[k].x, part[k].y, edge[k], noise[scan[k]]};
    fit_circle(&mine, circle + CIRCLE_NUMBERS * k);
}
