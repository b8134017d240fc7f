"""Reflectors: bright runs of beams in simulated scans, and in a recording against the sensor's positions."""

from __future__ import annotations

import math

import numpy as np
import pytest

import gpusense as gs

SCANNER = gs.Scanner.uniform(angle_min=-math.pi, angle_increment=math.radians(0.25), count=1440, range_max=30.0,
                             mount=(0.2, -0.1, 0.3))  # fmt: skip
# Centres of cylinders in the scanner's frame, one of them behind, where the beams begin and end.
CENTRES, RADIUS = np.array([(3.0, 1.0), (-5.0, 0.01), (0.5, -7.0)]), 0.045


def scan(seed: int = 0, noise: float = 0.01) -> tuple[np.ndarray, np.ndarray]:
    """Return ranges and intensities of a round room with shining cylinders."""
    rng = np.random.default_rng(seed)
    along = np.column_stack([np.cos(SCANNER.bearings), np.sin(SCANNER.bearings)])
    ranges, light = np.full(1440, 9.0), 1.0 + 0.1 * rng.standard_normal(1440)
    for centre in CENTRES:
        ahead = along @ centre
        off = np.abs(along[:, 0] * centre[1] - along[:, 1] * centre[0])
        hit = (off < RADIUS) & (ahead > 0)
        ranges[hit] = ahead[hit] - np.sqrt(RADIUS**2 - off[hit] ** 2)
        light[hit] = 7.0 * np.sqrt(1 - (off[hit] / RADIUS) ** 2) + 1.0
    return ranges + noise * rng.standard_normal(1440), light


def test_reflectors_are_where_they_shine():
    expected = CENTRES @ np.array([[math.cos(0.3), math.sin(0.3)], [-math.sin(0.3), math.cos(0.3)]]) + (0.2, -0.1)
    squares = []
    for seed in range(30):
        ranges, light = scan(seed)
        found = gs.extract_features(ranges, SCANNER, "reflector", backend="numpy", intensities=light)
        assert len(found) == 3
        off = found.pose[:, None, :2] - expected
        nearest = np.hypot(off[..., 0], off[..., 1]).argmin(axis=1)
        assert sorted(nearest) == [0, 1, 2] and np.abs(off[np.arange(3), nearest]).max() < 0.05
        np.testing.assert_allclose(found.size, RADIUS, atol=0.02)
        error = off[np.arange(3), nearest]
        squares += np.einsum("fi,fij,fj->f", error, found.information[:, :2, :2], error).tolist()
    assert 0.3 < np.mean(squares) / 2 < 2.0


@pytest.mark.parametrize("value", [math.inf, math.nan, -math.inf, 30.0, 0.0, -1.0])
def test_missing_readings_beside_each_other_are_no_feature(value):
    ranges, light = scan()
    gone = ranges.copy()
    gone[[3, 4, 5, -2, -1, 0]] = value
    found = gs.extract_features(gone, SCANNER, "reflector", backend="numpy", intensities=light)
    # One reflector is behind the scanner, where its beams begin and end.
    assert len(found) == 2
    assert not len(gs.extract_features(np.full(1440, value), SCANNER, backend="numpy", intensities=light))


def test_reflectors_need_light():
    ranges, light = scan()
    for intensities in (None, np.ones(1440), np.zeros(1440), np.full(1440, np.nan), light.clip(max=2.5)):
        assert len(gs.extract_features(ranges, SCANNER, "reflector", backend="numpy", intensities=intensities)) == 0
    # Beams without a return are not bright; a wall that is bright along its whole length is no reflector.
    assert len(gs.extract_features(np.full(1440, np.inf), SCANNER, "reflector", intensities=light)) == 0
    wide = np.where(np.abs(SCANNER.bearings) < 0.2, 8.0, 1.0)
    assert len(gs.extract_features(np.full(1440, 5.0), SCANNER, "reflector", intensities=wide)) == 0


def test_bad_intensities_are_named():
    ranges, light = scan()
    with pytest.raises(ValueError, match=r"^intensities: shape must be that of the readings, \(1, 1440\), got"):
        gs.extract_features(ranges, SCANNER, intensities=light[1:])
    with pytest.raises(TypeError, match=r"^intensities: must hold real numbers"):
        gs.extract_features(ranges, SCANNER, intensities=["bright"] * 1440)


@pytest.mark.long
def test_reflectors_of_a_recording(data_dir):
    """Most scans show the six reflectors of jarvis_lab's AGV at their positions on its map."""
    folder = data_dir / "jarvis_lab"
    bag = folder / "jarvis_complex_path_fast.bag"
    scans = list(gs.read_log(bag, topic="/driver_laser_navigation/laser_scan"))[::10]
    assert all(one.intensities.shape == one.ranges.shape and not one.intensities.flags.writeable for one in scans)
    with np.load(folder / "jarvis_complex_path_fast.npz") as run:
        poses, valid = run["nav350_gt_pose"][::10], run["nav350_gt_valid"][::10]
    ranges, light = (np.array([getattr(one, name) for one in scans])[valid] for name in ("ranges", "intensities"))
    found = gs.extract_features(ranges, scans[0].scanner, "reflector", intensities=light)
    mapped = gs.map_features(found, poses[valid], least=10)
    # Medians of the positions that the sensor reports in beacons_scan, at the same poses.
    reported = [(5.818, 0.779), (-1.464, 4.212), (2.844, 4.328), (0.926, -2.365), (-6.722, -0.485), (-6.806, 3.058)]
    apart = np.hypot(*np.moveaxis(mapped.pose[:, None, :2] - reported, 2, 0))
    assert len(mapped) == 6 and sorted(apart.argmin(axis=1)) == list(range(6)) and apart.min(axis=1).max() < 0.09
    assert mapped.count.sum() > 0.85 * 6 * valid.sum() and mapped.count.sum() > 0.9 * len(found)
    landmarks = mapped.landmarks("reflector")
    assert (landmarks.signatures // 10 == 5).all()
