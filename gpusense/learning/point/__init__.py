"""Parameters of position fixes, headings, ranges to beacons and bumpers, learned from readings at known poses.

``absolute``, ``beacons`` and ``bumper`` hold the public functions and the densities with their gradients.
``problem`` is their base and maximises the log-likelihood, ``report`` describes the result.
"""
