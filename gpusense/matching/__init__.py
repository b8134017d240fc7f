"""Poses of scans and local maps relative to scans and maps."""
