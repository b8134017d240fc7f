"""Sweeps: many independent jobs over processes, devices and machines, and one filter over several devices."""
