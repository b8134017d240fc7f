"""Error-free transformations: a second number holds the rounding error of an operation."""

import warp as wp

from .flags import FLOAT64, ROUNDED_CELLS
from .prelude import exact_fma, fuses, on_gpu
from .types import real, vec2, vec4

# Sums over beams add the terms of a block plainly, then the sum of the block to a compensated total. The accuracy is
# nearly that of compensating every term, the cost nearly that of compensating none. A block of the beam model's sums
# has STRANDS strands; strand i has every fourth term from term i on. Each strand is added plainly, then its sum to the
# compensated total. So work-items or lanes that share a block exchange no terms.
multiply_add = exact_fma(real)
# Beside fused products the loop that rounds cells takes 1.4 times as long on processors.
at_once = on_gpu if ROUNDED_CELLS else fuses
SPLITTER = real(134217729.0 if FLOAT64 else 4097.0)


@wp.func
def two_sum(a: real, b: real):
    """Return a + b = sum.x + sum.y exactly."""
    total = a + b
    shift = total - a
    return vec2(total, (a - (total - shift)) + (b - shift))


@wp.func
def ordered_sum(a: real, b: real):
    """Return a + b = sum.x + sum.y exactly, where a's exponent is at least b's: Dekker's sum."""
    total = a + b
    return vec2(total, b - (total - a))


@wp.func
def high_half(a: real):
    """Return the leading bits of a float, so few that the product of two such halves is exact."""
    scaled = SPLITTER * a
    return scaled - (scaled - a)


@wp.func
def two_product(a: real, b: real):
    """Return a * b = product.x + product.y exactly, barring overflow and underflow."""
    product = a * b
    if at_once():
        return vec2(product, multiply_add(a, b, -product))
    a_high = high_half(a)
    b_high = high_half(b)
    a_low = a - a_high
    b_low = b - b_high
    error = ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low
    return vec2(product, error)


@wp.func
def rest_of(a: real, b: real, c: real):
    """Return c - a b, where c is a b rounded or nearly so."""
    if at_once():
        return multiply_add(-a, b, c)
    product = two_product(a, b)
    return (c - product.x) - product.y


@wp.func
def pair_sum(a: vec2, b: vec2):
    """Add two numbers of two parts each, to about twice the working precision."""
    total = two_sum(a.x, b.x)
    return ordered_sum(total.x, total.y + (a.y + b.y))


@wp.func
def pair_product(a: vec2, b: vec2):
    """Multiply two numbers of two parts each, to about twice the working precision."""
    product = two_product(a.x, b.x)
    return ordered_sum(product.x, product.y + (a.x * b.y + a.y * b.x))


@wp.func
def add_term(total: vec2, term: real):
    """Add a term to a compensated sum: total.x is the running sum, total.y the sum of its rounding errors."""
    head = two_sum(total.x, term)
    return vec2(head.x, total.y + head.y)


@wp.func
def scaled_sum(total: vec2, factor: real):
    """Return a factor times a sum in two parts, or the sum if it is infinite."""
    return wp.where(wp.isinf(total.x), total.x, factor * (total.x + total.y))


@wp.func
def add_strands(total: vec2, strands: vec4):
    """Add a block to a compensated sum, by its strands."""
    return add_term(add_term(add_term(add_term(total, strands[0]), strands[1]), strands[2]), strands[3])
