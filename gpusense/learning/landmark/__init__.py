"""Parameters of the landmark model from features."""
