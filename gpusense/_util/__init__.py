"""Check arguments, write files whole, show progress; no domain."""
