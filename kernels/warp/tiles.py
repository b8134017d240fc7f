"""Tiles of work-items for GPUs: a work-group takes a tile of neighbouring particles and rays with similar paths. spread
= s gives a tile of particles 2^s groups, each with every 2^s-th tile of rays, so that few particles also fill a device.
Particles are in the order of the file order, if it was computed.
"""

import warp as wp

TILE_RAYS = wp.constant(4)
TILE_PARTICLES = wp.constant(16)
TILE = wp.constant(64)


@wp.func
def tile_place(item: wp.int32, spread: wp.int32):
    """Return the place of a work-item's particle in the order."""
    return ((item // TILE) >> spread) * TILE_PARTICLES + item % TILE // TILE_RAYS


@wp.func
def tile_group(item: wp.int32, spread: wp.int32):
    """Return a work-item's group within its tile of particles."""
    return (item // TILE) & ((1 << spread) - 1)


@wp.func
def tile_ray(item: wp.int32, spread: wp.int32):
    """Return the first ray of a work-item."""
    return ((item // TILE) & ((1 << spread) - 1)) * TILE_RAYS + item % TILE_RAYS


@wp.func
def tile_step(spread: wp.int32):
    """Return the step from one ray of a work-item to its next."""
    return TILE_RAYS << spread
