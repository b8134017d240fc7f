"""Occupancy grids made from scans and poses."""
