"""Checks of arguments, atomic file writes and progress bars; nothing of the domain."""
