"""Learn the parameters of the landmark model from features."""
