"""Build occupancy grids from scans and poses."""
