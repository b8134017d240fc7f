"""Localization of a robot: particle weights and resampling."""
