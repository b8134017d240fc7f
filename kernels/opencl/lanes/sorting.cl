// Sort short lists of numbers, with 8 comparisons at once: sorting.cl.

// Write count numbers, a multiple of 8, in ascending order: each goes to the place that as many numbers precede.
void sort_numbers(global const double *number, const int count, global double *sorted) {
    for (int i = 0; i < count; ++i) {
        const double mine = number[i];
        const long8 own = (long8)(i) - (long8)(0, 1, 2, 3, 4, 5, 6, 7);
        long8 before = 0;
        for (int j = 0; j < count; j += 8) {
            const double8 other = vload8(0, number + j);
            before -= (other < mine) | ((other == mine) & ((long8)(j) < own));
        }
        const long4 four = before.lo + before.hi;
        const long2 two = four.lo + four.hi;
        sorted[two.x + two.y] = mine;
    }
}
