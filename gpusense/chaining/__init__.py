"""Trajectories from scans alone: chained matches over key scans, loop closures, and the pose graph of both."""
