"""Oracles, scenes, stand-ins and lists of bad input that tests share; fixtures are in the files ``conftest.py``."""
