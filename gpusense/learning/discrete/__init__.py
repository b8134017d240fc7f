"""The discrete model of proximity sensors, and its causes from readings."""
