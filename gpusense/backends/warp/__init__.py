"""The Warp backend."""
