"""Run many independent jobs over processes, devices and machines."""
