"""The discrete model of proximity sensors: its table, and its causes learned from readings."""
