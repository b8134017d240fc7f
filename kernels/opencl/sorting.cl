// Sort short lists of numbers.

// Write count numbers, a multiple of 8, in ascending order: each goes to the place that as many numbers precede.
void sort_numbers(global const double *number, const int count, global double *sorted) {
    for (int i = 0; i < count; ++i) {
        const double mine = number[i];
        int before = 0;
        for (int j = 0; j < count; ++j) before += number[j] < mine || (number[j] == mine && j < i);
        sorted[before] = mine;
    }
}
