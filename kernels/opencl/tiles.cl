// Work-items for GPUs: a work-group takes a tile of neighbouring particles and rays, so that its rays take much the same
// way. With spread = s a tile of particles has 2^s groups, each with every 2^s-th tile of rays: few particles fill a
// device, too. Particles come in the order of the kernel file order where that was made.

#define TILE_RAYS 4
#define TILE_PARTICLES 16
#define TILE (TILE_RAYS * TILE_PARTICLES)

// Place in the order of a work-item's particle, which of the groups of its tile of particles it belongs to, its first
// ray, and how many rays farther the next one is.
int tile_place(const int item, const int spread) {
    return ((item / TILE) >> spread) * TILE_PARTICLES + item % TILE / TILE_RAYS;
}
int tile_group(const int item, const int spread) { return (item / TILE) & ((1 << spread) - 1); }
int tile_ray(const int item, const int spread) { return tile_group(item, spread) * TILE_RAYS + item % TILE_RAYS; }
int tile_step(const int spread) { return TILE_RAYS << spread; }
