// Class of a reading: a hit, a max reading, or missing (neither). The limits are those of range_limits in
// gpusense/world/scanner.py; NaN is missing by both comparisons.

// Return whether a reading is a range.
int is_hit(const double reading, const double nearest, const double farthest) {
    return reading >= nearest && reading < farthest;
}

// Return whether a reading is "no return" (REP-117).
int is_max(const double reading, const double farthest) { return reading >= farthest; }
