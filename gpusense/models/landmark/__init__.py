"""The landmark model."""
