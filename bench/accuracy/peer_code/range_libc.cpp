// range_libc's casters as C functions; bench/speed/baselines.py compiles it against a copy of range_libc.
#include "includes/RangeLib.h"

namespace {

enum Kind { BRESENHAM, MARCHING, CDDT, PRUNED_CDDT, LOOK_UP };

template <class Caster>
void cast_all(Caster &caster, const float *poses, long particles, const float *angles, long beams, float *found) {
    for (long i = 0; i < particles; ++i)
        for (long k = 0; k < beams; ++k)
            found[i * beams + k] = caster.calc_range(poses[3 * i], poses[3 * i + 1], poses[3 * i + 2] + angles[k]);
}

ranges::OMap map_of(const unsigned char *occupied, int width, int height) {
    ranges::OMap map(width, height);
    for (int x = 0; x < width; ++x)
        for (int y = 0; y < height; ++y) map.grid[x][y] = occupied[static_cast<long>(y) * width + x] != 0;
    return map;
}

}  // namespace

extern "C" {

// (height, width) cells, the row first; range_max in cells; bins over a whole turn.
void *make(int kind, const unsigned char *occupied, int width, int height, float range_max, int bins) {
    ranges::OMap map = map_of(occupied, width, height);
    if (kind == BRESENHAM) return new ranges::BresenhamsLine(map, range_max);
    if (kind == MARCHING) return new ranges::RayMarching(map, range_max);
    if (kind == LOOK_UP) return new ranges::GiantLUTCast(map, range_max, bins);
    auto *caster = new ranges::CDDTCast(map, range_max, bins);
    if (kind == PRUNED_CDDT) caster->prune(range_max);
    return caster;
}

// (particles, 3) poses in cells and radians, (beams,) angles, (particles, beams) ranges in cells.
void cast(int kind, void *caster, const float *poses, long particles, const float *angles, long beams, float *found) {
    if (kind == BRESENHAM)
        cast_all(*static_cast<ranges::BresenhamsLine *>(caster), poses, particles, angles, beams, found);
    else if (kind == MARCHING)
        cast_all(*static_cast<ranges::RayMarching *>(caster), poses, particles, angles, beams, found);
    else if (kind == LOOK_UP)
        cast_all(*static_cast<ranges::GiantLUTCast *>(caster), poses, particles, angles, beams, found);
    else
        cast_all(*static_cast<ranges::CDDTCast *>(caster), poses, particles, angles, beams, found);
}

void destroy(int kind, void *caster) {
    if (kind == BRESENHAM)
        delete static_cast<ranges::BresenhamsLine *>(caster);
    else if (kind == MARCHING)
        delete static_cast<ranges::RayMarching *>(caster);
    else if (kind == LOOK_UP)
        delete static_cast<ranges::GiantLUTCast *>(caster);
    else
        delete static_cast<ranges::CDDTCast *>(caster);
}
}
