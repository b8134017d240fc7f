"""Sums of the terms of readings, or of blocks of readings, in the order of the readings."""

import warp as wp

from gpusense.interface.constants import BLOCK_TERMS, STRANDS

from .error_free import add_strands, add_term
from .flags import CUBES, ORDERED, SCANS, STRANDED
from .prelude import kernel, reader, work_item
from .types import real, vec2, vec4

number_at = reader(real)
block_terms = wp.types.vector(length=BLOCK_TERMS, dtype=real)
ZERO = real(0.0)


@kernel
def sum_parts(parts, order, counts, constant_terms, log_p, particles, count, block, score, batch):
    """Sum count numbers, number k at parts[place + k * particles]: one work-item takes a particle."""
    place = work_item(wp.tid())
    if place >= particles:
        return
    n = place
    if ORDERED:
        n = order[place]
    size = count
    constant_term = score.constant_term
    if SCANS:
        size = counts[n // batch.per_scan]
        if STRANDED:
            size = size // BLOCK_TERMS * STRANDS + wp.min(size % BLOCK_TERMS, STRANDS)
        constant_term = constant_terms[n // batch.per_scan]
    total = vec2(constant_term, ZERO)
    first = int(0)
    while first < size:
        term = block_terms()
        for i in range(BLOCK_TERMS):
            if first + i < size:
                term[i] = number_at(parts, place + (first + i) * particles)
        if block == 1:
            for i in range(BLOCK_TERMS):
                total = add_term(total, term[i])
        else:
            for i in range(STRANDS, BLOCK_TERMS):
                term[i % STRANDS] = term[i % STRANDS] + term[i]
            total = add_strands(total, vec4(term[0], term[1], term[2], term[3]))
        first += BLOCK_TERMS
    if CUBES:
        log_p[n] = score.temperature * wp.log(total.x + total.y)
    elif wp.isinf(total.x):
        log_p[n] = total.x
    else:
        log_p[n] = score.temperature * (total.x + total.y)
