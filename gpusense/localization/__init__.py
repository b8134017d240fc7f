"""Localisation of a robot: the particle filter, its motion models, weights and temperature."""
