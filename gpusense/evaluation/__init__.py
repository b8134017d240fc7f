"""Evaluate devices and models: the proof of a device."""
