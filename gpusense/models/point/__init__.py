"""Models of sensors with one reading for each pose."""
