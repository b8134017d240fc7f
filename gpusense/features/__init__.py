"""Extract features from scans: lines, corners, doors, hallways, poles and reflectors."""
