// Rows of a map as bits, 1 where a cell is occupied: 32 cells a word, the first cell in the lowest bit. The unused bits
// of the last word of a row are 0. One read of a word gives 32 cells.

#define NONE 0x7fffffff

// Return the index of the lowest 1 of a word that is not 0.
int lowest_bit(const uint word) { return 31 - (int)clz(word & (~word + 1)); }

// Return the index of the highest 1 of a word that is not 0.
int highest_bit(const uint word) { return 31 - (int)clz(word); }

// Count the cells from a cell to the first occupied one to its right, itself included; NONE if none is within most
// cells. An occupied cell beyond most cells may also be returned.
int cells_right(global const int *row, const int words, const int col, const int most) {
    const int last = min((col + most) >> 5, words - 1);
    int i = col >> 5;
    uint word = (uint)row[i] & (0xffffffffu << (col & 31));
    while (word == 0 && i < last) word = (uint)row[++i];
    return word == 0 ? NONE : 32 * i + lowest_bit(word) - col;
}

// Count the cells to the first occupied one to its left.
int cells_left(global const int *row, const int col, const int most) {
    const int last = max(col - most, 0) >> 5;
    int i = col >> 5;
    uint word = (uint)row[i] & (0xffffffffu >> (31 - (col & 31)));
    while (word == 0 && i > last) word = (uint)row[--i];
    return word == 0 ? NONE : col - 32 * i - highest_bit(word);
}
