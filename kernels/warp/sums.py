"""Sums of what single readings, or blocks of them, add to a scan's logarithm, in the order of the readings."""

import functools

import warp as wp

from . import error_free
from .error_free import BLOCK_TERMS
from .prelude import kernel, precision, reader


@functools.cache
def make(name, flags):
    """The kernel sum_parts specialised by the flags."""
    types = precision(flags)
    real, vec2 = types.real, types.vec2
    add_term = error_free.functions(flags).add_term
    number_at = reader(real)
    block_terms = wp.types.vector(length=BLOCK_TERMS, dtype=real)
    ORDERED = "ORDERED" in flags
    CUBES = "CUBES" in flags
    SCANS = "SCANS" in flags
    ZERO = real(0.0)

    # One work-item a particle: count numbers, each along farther than the last, from parts[place * across] on. A block
    # of them, 1 or BLOCK_TERMS, is added plainly, then its sum to a compensated total. BLOCK_TERMS numbers are read
    # before any is added, so that a work-item waits once for all of them; what lies beyond the last counts as 0, which
    # changes no sum. Of several scans each has a count of its own.
    @kernel
    def sum_parts(
        parts: wp.array(dtype=real),
        order: wp.array(dtype=wp.int32),
        counts: wp.array(dtype=wp.int32),
        fixed_of: wp.array(dtype=real),
        log_p: wp.array(dtype=real),
        particles: wp.int32,
        count: wp.int32,
        block: wp.int32,
        across: wp.int32,
        along: wp.int32,
        fixed: real,
        temperature: real,
        per_scan: wp.int32,
    ):
        place = wp.tid()
        if place >= particles:
            return
        n = place
        if ORDERED:
            n = order[place]
        part = place * across
        own = count
        lead = fixed
        if SCANS:
            own = counts[n // per_scan]
            lead = fixed_of[n // per_scan]
        total = vec2(lead, ZERO)
        first = int(0)
        while first < own:
            term = block_terms()
            for i in range(BLOCK_TERMS):
                if first + i < own:
                    term[i] = number_at(parts, part + (first + i) * along)
            if block == 1:
                for i in range(BLOCK_TERMS):
                    total = add_term(total, term[i])
            else:
                summed = real(0.0)
                for i in range(BLOCK_TERMS):
                    summed += term[i]
                total = add_term(total, summed)
            first += BLOCK_TERMS
        if CUBES:
            log_p[n] = temperature * wp.log(total.x + total.y)
        elif wp.isinf(total.x):
            log_p[n] = total.x
        else:
            log_p[n] = temperature * (total.x + total.y)

    return {"sum_parts": sum_parts}[name]
