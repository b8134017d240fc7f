"""Beacons seen by a real robot (a camera's fiducials, ENMT482) against its pose from SLAM."""

from __future__ import annotations

import gzip
import itertools

import numpy as np
import pytest

import gpusense as gs

# Errors of single sightings against the reference pose, including errors of map and reference.
SIGMA_RANGE, SIGMA_BEARING = 0.06, 0.03


@pytest.fixture(scope="module")
def sightings(data_dir):
    """Return the moments at which two or more mapped beacons were seen: reference pose, beacons, ranges, bearings."""
    folder = data_dir / "beacons_enmt482"
    rows = np.genfromtxt(folder / "beacon_map.csv", delimiter=",", skip_header=1)
    places = {int(row[0]): row[1:3] for row in rows}
    with gzip.open(folder / "data.csv.gz", "rt") as stream:
        table = [line.rstrip("\n").split(",") for line in itertools.islice(stream, 1, None)]
    seen = [row for row in table if row[9] and int(float(row[9])) in places]
    moments = []
    for _, group in itertools.groupby(seen, key=lambda row: row[0]):
        rows = list(group)
        if len(rows) < 2:
            continue
        pose = np.array(rows[0][3:6], float)
        xy = np.array([places[int(float(row[9]))] for row in rows])
        local = np.array([row[10:12] for row in rows], float)
        moments.append((pose, xy, np.hypot(*local.T), np.arctan2(local[:, 1], local[:, 0])))
    return moments


def errors(fixes, truths):
    """Return the distance of the nearest solution of each fix from the truth [m]."""
    return np.array([np.hypot(*(f.solutions[:, :2] - t[:2]).T).min() for f, t in zip(fixes, truths, strict=True)])


def quantiles(values):
    """Return the median and the 90 % quantile."""
    return np.quantile(values, [0.5, 0.9])


def test_two_fiducials(sightings):
    """Fixes are as near the reference as single sightings: some cm, plus cm for 0.01 rad over a few metres.

    The bounds include the errors of map and reference: ranges of sightings are off by 5 cm in the median and 13 cm at
    90 %, their bearings by 0.008 and 0.03 rad.
    """
    truths = [pose for pose, *_ in sightings]
    assert len(truths) > 200
    deviations = {"sigma_range": SIGMA_RANGE, "sigma_bearing": SIGMA_BEARING}
    circles = [gs.trilaterate(xy, r, sigma=SIGMA_RANGE) for _, xy, r, _ in sightings]
    poses = [gs.locate(xy, r, b, **deviations) for _, xy, r, b in sightings]
    rays = [gs.triangulate(xy, b, pose[2], sigma=SIGMA_BEARING) for pose, xy, _, b in sightings]
    single = [gs.locate(xy[:1], r[:1], b[:1], pose[2], **deviations) for pose, xy, r, b in sightings]
    assert all(fix.status in ("two", "contained") for fix in circles)
    assert all(fix.status == "unique" for fix in [*poses, *rays, *single])
    for fixes, median, most in ((circles, 0.15, 0.4), (poses, 0.15, 0.3), (rays, 0.04, 0.12), (single, 0.08, 0.2)):
        found = quantiles(errors(fixes, truths))
        assert found[0] < median and found[1] < most, (found, median, most)
    turns = np.array([np.angle(np.exp(1j * (f.best[2] - t[2]))) for f, t in zip(poses, truths, strict=True)])
    assert quantiles(np.abs(turns))[0] < 0.08 and quantiles(np.abs(turns))[1] < 0.12
    # Errors fit the covariance: the median of chi-squared is 2.4 for three degrees of freedom.
    away = [f.best - t for f, t in zip(poses, truths, strict=True)]
    for error, turn in zip(away, turns, strict=True):
        error[2] = turn
    scaled = [e @ np.linalg.solve(f.covariance[0], e) for e, f in zip(away, poses, strict=True)]
    assert 1.0 < np.median(scaled) < 4.0
