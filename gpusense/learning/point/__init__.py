"""Parameters of position fixes, headings, ranges to beacons and bumpers, learned from readings at known poses.

``beacons``, ``heading``, ``bumper`` and ``position`` hold the public functions and the densities with their gradients.
``problem`` is their base, ``search`` maximises the log-likelihood, ``report`` and ``result`` describe the result.
"""
