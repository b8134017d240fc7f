// Tiles of work-items for GPUs: a work-group takes a tile of neighbouring particles and rays with similar paths. spread
// = s gives a tile of particles 2^s groups, each with every 2^s-th tile of rays, so that few particles also fill a
// device. Particles are in the order of the file order, if it was computed.

#define TILE_RAYS 4
#define TILE_PARTICLES 16
#define TILE (TILE_RAYS * TILE_PARTICLES)

// Return the place of a work-item's particle in the order.
int tile_place(const int item, const int spread) {
    return ((item / TILE) >> spread) * TILE_PARTICLES + item % TILE / TILE_RAYS;
}

// Return a work-item's group within its tile of particles.
int tile_group(const int item, const int spread) { return (item / TILE) & ((1 << spread) - 1); }

// Return the first ray of a work-item.
int tile_ray(const int item, const int spread) { return tile_group(item, spread) * TILE_RAYS + item % TILE_RAYS; }

// Return the step from one ray of a work-item to its next.
int tile_step(const int spread) { return TILE_RAYS << spread; }
