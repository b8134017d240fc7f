"""Learning the parameters of measurement models from readings and what was expected of them."""
