"""Localise a robot: weights of particles."""
