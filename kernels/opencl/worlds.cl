// Many worlds in one table: their cells, obstacles and tables, poses placed in them, and collisions. Worlds of one size
// are made together. Their rows are interleaved: line i is row i / worlds of world i % worlds. place holds each world's
// first cell in tables with a ring of two cells.
// requires: placement shapes

// Cells above this one are unknown.
#define MOST_KNOWN 127
#define RING 2

// Copy the cells of some worlds to their places, four at once where they are aligned, as the places are. One work-item
// takes every items-th.
kernel void put_cells(ARGUMENTS) {
    const int first = get_global_id(0), w = get_global_id(1);
    if (first >= items || w >= worlds) return;
    global const uchar *from = cells + (long)w * count;
    global uchar *to = store + place[w];
    const int fours = ((size_t)from & 3) == 0 ? count / 4 : 0;
    for (int i = first; i < fours; i += items) ((global uint *)to)[i] = ((global const uint *)from)[i];
    for (int i = 4 * fours + first; i < count; i += items) to[i] = from[i];
}

// Return whether a cell stops a beam.
int stops_beam(const int cell, const int threshold, const int unknown) {
    return cell > MOST_KNOWN ? unknown : cell >= threshold;
}

// Mark the obstacles of worlds as bytes or as bits, with a margin of obstacles around each world. One work-item takes 32
// cells of a line.
kernel void mark_obstacles(ARGUMENTS) {
    const int item = get_global_id(0), word = item % words, line = item / words, width = cols + 2 * margin;
    if (line >= (rows + 2 * margin) * worlds) return;
    const int row = line / worlds - margin, w = line % worlds;
    uint marked = 0;
    for (int i = 0; i < 32 && 32 * word + i < width; ++i) {
        const int col = 32 * word + i - margin;
        const int inside = col >= 0 && col < cols && row >= 0 && row < rows;
        const int stops = inside ? stops_beam(store[place[w] + (long)row * cols + col], threshold, unknown) : 1;
        if (!as_bits) occupied[(long)line * width + 32 * word + i] = (uchar)stops;
        marked |= (uint)stops << i;
    }
    if (as_bits) bits[(long)line * words + word] = (int)marked;
}

// Fill the likelihood fields of worlds from squared distances, which include a margin. One work-item takes a cell.
kernel void fill_worlds(ARGUMENTS) {
    const int col = get_global_id(0), line = get_global_id(1), width = cols + 2 * RING;
    if (col >= width || line >= (rows + 2 * RING) * worlds) return;
    const int row = line / worlds, w = line % worlds;
    const int from_row = row - RING + margin, from_col = col - RING + margin;
    const int inside = from_row >= 0 && from_row < rows + 2 * margin && from_col >= 0 && from_col < cols + 2 * margin;
    const long at = ((long)from_row * worlds + w) * (cols + 2 * margin) + from_col;
    table[place[w] + (long)row * width + col] = inside ? density[min(squared[at], cap)] : beyond;
}

// Place poses in their worlds; see place_pose. An index of no world sets the second bit of pose_status, and the pose
// sees nothing. With SEES its sights, see the file shapes, become empty. One work-item takes a particle.
kernel void place_in_worlds(ARGUMENTS) {
    const int particle = get_global_id(0);
    if (particle >= particles) return;
    // Indices of 64 bits have 0 in the upper half.
    const int chosen = index[wide * particle], whole = wide == 1 || index[2 * particle + 1] == 0;
    const int known = whole && chosen >= 0 && chosen < worlds, w = known ? chosen : 0;
    global const double *numbers = frames + (long)w * FRAME_NUMBERS;
    const Window window = {0, 0, (int)numbers[4], (int)numbers[5]};
    place_pose(particle, poses, pose_cell, pose, pose_low, pose_status, frame_in(frames, w, frame), window);
    if (!known) {
        atomic_or(&pose_status[0], 2);
        pose_cell[particle] = (int2)(-(int)FARTHEST, -(int)FARTHEST);
    }
    world[2 * particle] = (int2)((int)numbers[6], window.rows << 16 | window.cols);
#if SHAPES
    world[2 * particle + 1] = (int2)(w, ignore[wide_ignore * particle]);
#if SEES
    for (int k = 0; k < SIGHTS * crowd.pairs; ++k) world[crowd.begin + (long)k * particles + particle] = 0;
#endif
#else
    world[2 * particle + 1] = (int2)(w, -1);
#endif
}

// Tell which discs about poses, with a radius in cells, meet an obstacle or a shape. One work-item takes a particle.
kernel void find_collisions(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n >= particles) return;
    const Window window = world_window(world, n);
    const int2 cell = pose_cell[n];
    const real2 point = (real2)(pose[n].x, pose[n].y);
#if SHAPES
    int met = shape_distance(shapes, world, crowd, n, cell, point) <= radius;
#else
    int met = 0;
#endif
    const int reach = (int)radius + 1;
    const int first_row = max(cell.y - reach, 0), last_row = min(cell.y + reach, window.rows - 1);
    const int first_col = max(cell.x - reach, 0), last_col = min(cell.x + reach, window.cols - 1);
    for (int row = first_row; row <= last_row; ++row) {
        const real below = row - cell.y - point.y, above = -(below + 1);
        const real off_y = below > 0 ? below : above > 0 ? above : 0;
        for (int col = first_col; col <= last_col; ++col) {
            const real left = col - cell.x - point.x, right = -(left + 1);
            const real off_x = left > 0 ? left : right > 0 ? right : 0;
            const int near = off_x * off_x + off_y * off_y <= radius * radius;
            if (near && stops_beam(store[world[2 * n].x + (long)row * window.cols + col], threshold, unknown)) met = 1;
        }
    }
    hit[n] = (uchar)met;
}
