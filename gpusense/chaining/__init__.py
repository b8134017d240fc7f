"""Trajectories from scans alone: matches chained over key scans, loops closed, and the pose graph of both."""
