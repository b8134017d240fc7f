"""The parts of same_bits.py: its cases, their configurations and actions, and the devices that run them."""
