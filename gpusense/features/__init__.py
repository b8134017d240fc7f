"""Features of scans: lines, corners, doors, hallways and poles."""
