"""Compute trajectories from scans: matches chained over key scans, loop closures, and their pose graph."""
