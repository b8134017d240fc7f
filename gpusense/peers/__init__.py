"""Reproduce the weights that other implementations give a scan."""
