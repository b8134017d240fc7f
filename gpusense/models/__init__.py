"""Measurement models: parameters, a map and a scanner, compiled for a device."""
