"""The weights that other implementations give a scan, and their parameters."""
