"""Classes of the Stanford diagram, and times to alert."""

from __future__ import annotations

import math

import numpy as np
import pytest

import gpusense as gs


def test_each_pose_has_one_class():
    rng = np.random.default_rng(0)
    errors, radii = rng.uniform(0, 2, 4000), rng.uniform(0, 2, 4000)
    found = gs.integrity(errors, radii, alert_limit=1.0)
    fine = np.mean((errors <= radii) & (radii <= 1.0))
    assert found.hazardous == pytest.approx(0.25, abs=0.03) and found.misleading == pytest.approx(0.125, abs=0.03)
    assert fine + found.hazardous + found.misleading == pytest.approx(found.available)
    assert found.exceeded == pytest.approx(0.5, abs=0.03)


def test_limits_belong_to_the_safe_side():
    found = gs.integrity([1.0, 0.5, 1.0], [1.0, 0.5, 0.9], alert_limit=1.0)
    assert (found.hazardous, found.available) == (0.0, 1.0) and found.misleading == pytest.approx(1 / 3)


def test_times_to_alert():
    none = math.inf
    errors = [0, 3, 3, 3, 0, 3, 3, 0, 3]
    radii = [0.1, 0.1, 0.1, none, none, 0.1, 0.1, 0.1, 4]
    found = gs.integrity(errors, radii, alert_limit=1.0, times=np.arange(9) * 0.5)
    assert found.times_to_alert.tolist() == [1.0, math.inf, 0.0]
    assert gs.integrity([0.1], [0.2], alert_limit=1.0).times_to_alert.shape == (0,)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (dict(errors=[-1.0, 0.0]), "errors: "),
        (dict(times=[1.0, 1.0]), "times: must increase"),
    ],
)
def test_bad_arguments_are_named(changes, message):
    arguments = dict(errors=[0.1, 0.2], radii=[1.0, 1.0], alert_limit=0.5) | changes
    with pytest.raises(ValueError, match=message):
        gs.integrity(arguments.pop("errors"), arguments.pop("radii"), **arguments)
