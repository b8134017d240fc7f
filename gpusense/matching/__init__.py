"""Poses of scans and local maps relative to other scans and maps."""
