/* Match successive scans by CSM's point-to-line ICP with its default options.

   Input, doubles: K, S, K bearings, S * K ranges (NaN where there is none), (S - 1) * 3 guesses.
   Output, doubles: (S - 1) * 4: valid, x, y, theta of each scan's sensor in the frame of the one before. */

#include <math.h>
#include <options/options.h>
#include <stdio.h>
#include <stdlib.h>

#include <csm/csm_all.h>

extern void sm_options(struct sm_params *p, struct option *ops);

static LDP make(int k, const double *bearings, const double *ranges) {
    LDP ld = ld_alloc_new(k);
    ld->min_theta = bearings[0];
    ld->max_theta = bearings[k - 1];
    for (int i = 0; i < k; i++) {
        ld->theta[i] = bearings[i];
        ld->valid[i] = isfinite(ranges[i]);
        ld->readings[i] = ranges[i];
    }
    return ld;
}

/* Match n pairs of scans of K bearings: ranges (n, K) of both, guesses (n, 3); found (n, 4) as the program writes it. */
int pairs(int k, int n, const double *bearings, const double *first, const double *second, const double *guesses,
          double *found) {
    struct sm_params params;
    struct option *ops = options_allocate(100);
    sm_options(&params, ops);
    params.min_reading = 0.01;
    params.max_reading = 1000.0;
    for (int i = 0; i < n; i++) {
        struct sm_result result;
        params.laser_ref = make(k, bearings, first + (size_t)i * k);
        params.laser_sens = make(k, bearings, second + (size_t)i * k);
        for (int j = 0; j < 3; j++) params.first_guess[j] = guesses[3 * i + j];
        sm_icp(&params, &result);
        double row[4] = {result.valid, result.x[0], result.x[1], result.x[2]};
        for (int j = 0; j < 4; j++) found[4 * i + j] = row[j];
        ld_free(params.laser_ref);
        ld_free(params.laser_sens);
    }
    return 0;
}

int main(int argc, const char *argv[]) {
    struct sm_params params;
    struct option *ops = options_allocate(100);
    double head[2];
    if (argc != 3) return 2;
    sm_options(&params, ops);
    if (!options_parse_args(ops, 1, argv)) return 2;
    FILE *in = fopen(argv[1], "rb"), *out = fopen(argv[2], "wb");
    if (!in || !out || fread(head, sizeof(double), 2, in) != 2) return 2;
    int k = (int)head[0], s = (int)head[1];
    double *bearings = malloc(k * sizeof(double)), *ranges = malloc((size_t)s * k * sizeof(double));
    double *guess = malloc((size_t)s * 3 * sizeof(double));
    if (fread(bearings, sizeof(double), k, in) != (size_t)k) return 2;
    if (fread(ranges, sizeof(double), (size_t)s * k, in) != (size_t)s * k) return 2;
    if (fread(guess, sizeof(double), 3 * (size_t)(s - 1), in) != 3 * (size_t)(s - 1)) return 2;
    params.min_reading = 0.01;
    params.max_reading = 1000.0;
    LDP before = make(k, bearings, ranges);
    for (int i = 1; i < s; i++) {
        struct sm_result result;
        LDP now = make(k, bearings, ranges + (size_t)i * k);
        params.laser_ref = before;
        params.laser_sens = now;
        for (int j = 0; j < 3; j++) params.first_guess[j] = guess[3 * (i - 1) + j];
        sm_icp(&params, &result);
        double row[4] = {result.valid, result.x[0], result.x[1], result.x[2]};
        fwrite(row, sizeof(double), 4, out);
        ld_free(before);
        before = now;
    }
    ld_free(before);
    return fclose(out) ? 2 : 0;
}
