"""Tests of posterior ranks by bounds with a stated probability of a false alarm."""

from __future__ import annotations

import numpy as np

from gpusense.evaluation.calibration import uniformity

# Each call may fail by chance with at most this probability; seeds are fixed.
FALSE_ALARM = 1e-4


def assert_uniform(ranks: np.ndarray) -> None:
    """Check that ranks are uniform, by two tests of each of four functions, which share the false alarms."""
    for name, p_values in uniformity(ranks).items():
        assert min(p_values) > FALSE_ALARM / 8, f"{name}: p = {p_values[0]:.2g} and {p_values[1]:.2g}"
