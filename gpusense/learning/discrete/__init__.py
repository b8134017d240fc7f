"""Discrete model of proximity sensors: its table, and learning its causes from readings."""
