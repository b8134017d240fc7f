"""Work-items for GPUs: a work-group takes a tile of neighbouring particles and rays, so that its rays take much the
same way. With spread = s a tile of particles has 2^s groups, each with every 2^s-th tile of rays: few particles fill a
device, too. Particles come in the order of the kernel file order where that was made.
"""

import warp as wp

TILE_RAYS = wp.constant(4)
TILE_PARTICLES = wp.constant(16)
TILE = wp.constant(64)


# Place in the order of a work-item's particle, which of the groups of its tile of particles it belongs to, its first
# ray, and how many rays farther the next one is.
@wp.func
def tile_place(item: wp.int32, spread: wp.int32):
    return ((item // TILE) >> spread) * TILE_PARTICLES + item % TILE // TILE_RAYS


@wp.func
def tile_group(item: wp.int32, spread: wp.int32):
    return (item // TILE) & ((1 << spread) - 1)


@wp.func
def tile_ray(item: wp.int32, spread: wp.int32):
    return ((item // TILE) & ((1 << spread) - 1)) * TILE_RAYS + item % TILE_RAYS


@wp.func
def tile_step(spread: wp.int32):
    return TILE_RAYS << spread
