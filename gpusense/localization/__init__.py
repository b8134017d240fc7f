"""Localise a robot: particle filter, motion models, weights and temperature."""
