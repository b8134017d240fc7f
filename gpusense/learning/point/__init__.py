"""Parameters of position fixes, headings, ranges to beacons and bumpers, learned from readings at known poses.

``absolute``, ``beacons`` and ``bumper`` hold the public functions and the densities with their gradients.
``problem`` is their base, maximises the log-likelihood, and describes the result.
"""
