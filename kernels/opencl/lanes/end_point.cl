// Cells of end points in lanes: functions of end_point.cl for LANES numbers at once, with the same bits.
// requires: end_point lanes/error_free

// in lanes: within whole_cells

// Poses of LANES particles: cells of the padded table, fractions of a cell, and directions.
typedef struct {
    ilanes col, row;
    lanes x, y, cos, sin;
} Particles;

// Set the pose of a lane; shift is subtracted from its fractions, then they and the direction are scaled.
void set_particle(Particles *particle, const int lane, const int2 cell, const real4 pose, const real shift,
                  const real scale) {
    ((lane_int *)&particle->col)[lane] = cell.x + FIELD_RING;
    ((lane_int *)&particle->row)[lane] = cell.y + FIELD_RING;
    ((real *)&particle->x)[lane] = (pose.x - shift) * scale;
    ((real *)&particle->y)[lane] = (pose.y - shift) * scale;
    ((real *)&particle->cos)[lane] = pose.z * scale;
    ((real *)&particle->sin)[lane] = pose.w * scale;
}
