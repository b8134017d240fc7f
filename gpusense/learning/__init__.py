"""Learn the intrinsic parameters of sensor models from data."""
