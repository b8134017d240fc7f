"""Parameters of the beam model from readings and expected ranges."""
