"""Class of a reading: a hit, a max reading, or missing (neither)."""

import warp as wp


@wp.func
def is_hit(reading: wp.float64, nearest: wp.float64, farthest: wp.float64):
    """Return whether a reading is a range."""
    return reading >= nearest and reading < farthest


@wp.func
def is_max(reading: wp.float64, farthest: wp.float64):
    """Return whether a reading is "no return" (REP-117)."""
    return reading >= farthest
