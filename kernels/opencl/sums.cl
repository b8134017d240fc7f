// Sums of the terms of readings, or of blocks of readings, in the order of the readings.
// requires: error_free

// Sum count numbers, number k at parts[place + k * particles]: one work-item takes a particle. They are sums of blocks
// or strands (block is 1), or single terms in blocks of BLOCK_TERMS; strands of a block are first added without
// compensation. All are added to a compensated total. SCANS: each scan has a separate count. STRANDED: the count is of
// readings, and the numbers are sums of their strands. BLOCK_TERMS numbers are read before any is added, so that a
// work-item waits once for all of them; numbers beyond the last count as 0, which changes no sum. There are fewer than
// 2^31 numbers.
kernel void sum_parts(ARGUMENTS) {
    const int place = get_global_id(0);
    if (place >= particles) return;
#if ORDERED
    const int n = order[place];
#else
    const int n = place;
#endif
#if SCANS
#if STRANDED
    const int terms = counts[n / batch.per_scan];
    const int size = terms / BLOCK_TERMS * STRANDS + min(terms % BLOCK_TERMS, STRANDS);
#else
    const int size = counts[n / batch.per_scan];
#endif
    const real constant_term = constant_terms[n / batch.per_scan];
#else
    const int size = count;
    const real constant_term = score.constant_term;
#endif
    real2 total = (real2)(constant_term, 0);
    for (int first = 0; first < size; first += BLOCK_TERMS) {
        real term[BLOCK_TERMS];
#pragma unroll
        for (int i = 0; i < BLOCK_TERMS; ++i) term[i] = parts[place + min(first + i, size - 1) * particles];
        if (first + BLOCK_TERMS > size) {
#pragma unroll
            for (int i = 0; i < BLOCK_TERMS; ++i) term[i] = first + i < size ? term[i] : 0;
        }
        if (block == 1) {
#pragma unroll
            for (int i = 0; i < BLOCK_TERMS; ++i) total = add_term(total, term[i]);
        } else {
            real4 strands = (real4)(term[0], term[1], term[2], term[3]);
#pragma unroll
            for (int i = STRANDS; i < BLOCK_TERMS; i += STRANDS)
                strands += (real4)(term[i], term[i + 1], term[i + 2], term[i + 3]);
            total = add_strands(total, strands);
        }
    }
#if CUBES
    log_p[n] = score.temperature * log(total.x + total.y);
#else
    log_p[n] = isinf(total.x) ? total.x : score.temperature * (total.x + total.y);
#endif
}
