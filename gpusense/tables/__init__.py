"""Compute tables of a map on a device: distances, rectangles, directional tables, look-ups, field and normals."""
