"""Utilities without domain knowledge: checks of arguments, atomic file writes, progress bars."""
