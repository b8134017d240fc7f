"""The rival of a filter leaves a sound track alone, finds a carried robot, and keeps a similar place."""

from __future__ import annotations

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
from support import filter_scene as scene

import gpusense as gs
from gpusense.localization import rival
from gpusense.localization.belief import IS_FOUND, ratio_of_places
from gpusense.localization.rival_search import RivalSearch, are_apart, drawn
from gpusense.localization.sensors import Sensor
from gpusense.matching.locate import likely_poses

# A building of four rooms of different sizes along a corridor, with doors.
CELLS = np.zeros((120, 200), np.int8)
CELLS[[0, 1, 70, 71, -2, -1]] = 100
CELLS[:, [0, 1, -2, -1]] = 100
CELLS[72:, [60, 61, 110, 111, 170, 171]] = 100
for door in (20, 80, 140, 180):
    CELLS[70:72, door : door + 10] = 0
CELLS[20:30, 40:44] = CELLS[40:44, 120:150] = CELLS[90:96, 80:90] = CELLS[100:118, 20:26] = CELLS[76:80, 118:126] = 100
GRID = gs.OccupancyGrid(CELLS, resolution=0.1)
SCANNER = gs.Scanner.uniform(angle_min=-math.pi, angle_increment=math.radians(4), count=90, range_max=25.0)
FIELD = gs.LikelihoodFieldParameters(z_hit=0.7, z_rand=0.3, sigma_hit=0.1, interpolation="bilinear")


def scans(poses, people=0.0, grid=GRID):
    caster = gs.RayCaster(grid, range_max=25.0, backend="opencl")
    rng = np.random.default_rng(1)
    z = caster.cast(np.asarray(poses), SCANNER.bearings) + rng.normal(0, 0.02, (len(poses), SCANNER.count))
    return np.where(rng.random(z.shape) < people, z * rng.random(z.shape), z)


def along(start, count, step=0.25):
    """Return poses of a robot that drives straight ahead."""
    x, y, theta = start
    s = step * np.arange(count)
    return np.column_stack([x + s * math.cos(theta), y + s * math.sin(theta), np.full(count, theta)])


def track(poses, ranges, pf, odometry=None):
    """Return the estimates of a filter along poses."""
    moved = poses if odometry is None else odometry
    found = []
    for k, z in enumerate(ranges):
        if k:
            pf.predict(moved[k - 1], moved[k])
        pf.correct(z)
        found.append(pf.estimate())
    return found


def error(estimate, pose):
    return math.hypot(*(estimate.pose - pose)[:2])


@pytest.fixture(scope="module")
def model():
    return gs.LikelihoodFieldModel(GRID, SCANNER, FIELD, backend="opencl")


def begun(model, pose, **options):
    pf = gs.ParticleFilter(model, particles=500, seed=2, **options)
    pf.initialize(mean=pose, covariance=np.diag([0.04, 0.04, 0.01]))
    return pf


def test_a_sound_track_among_people_has_the_bits_of_a_filter_without_recovery(model):
    poses = along((2.0, 4.0, 0.05), 50)
    ranges = scans(poses, people=0.4)
    one, other = begun(model, poses[0]), begun(model, poses[0], recovery=None)
    assert one.options.recovery == "sensor"
    assert all(error(e, pose) < 0.2 for e, pose in zip(track(poses, ranges, one), poses, strict=True))
    track(poses, ranges, other)
    assert np.array_equal(one.host_particles(), other.host_particles())


def test_a_turn_that_the_odometry_misses_is_found_again(model):
    poses = along((3.0, 4.0, 0.0), 30)
    poses[10:] = along((*poses[9][:2], 1.4), 20, 0.05)
    odometry = along((0.0, 0.0, 0.0), 30)
    odometry[10:] = along((*odometry[9][:2], 0.0), 20, 0.05)
    found = track(poses, scans(poses), begun(model, poses[0]), odometry)
    assert all(error(e, pose) < 0.2 for e, pose in zip(found[:10], poses, strict=False))
    # Scans along the robot's path confirm a place that a search found.
    assert all(error(e, pose) < 0.2 and not e.lost for e, pose in zip(found[-8:], poses[-8:], strict=True))


def test_a_robot_that_is_carried_away_is_lost_until_its_rival_has_won(model):
    poses = np.vstack([along((3.0, 4.0, 0.0), 12), along((13.0, 9.5, 0.3), 40, 0.05)])
    odometry = np.vstack([along((0.0, 0.0, 0.0), 12), along((2.75, 0.0, 0.0), 40, 0.05)])
    pf = begun(model, poses[0])
    found = track(poses, scans(poses), pf, odometry)
    wrong = np.array([error(e, pose) > 1 for e, pose in zip(found, poses, strict=True)])
    assert wrong[12] and not wrong[:12].any() and not wrong[-10:].any()
    # Until the rival has scans, a crowd might hide the walls.
    assert sum(e.verdict == "tracking" for e, off in zip(found, wrong, strict=True) if off) <= 6
    without = track(poses, scans(poses), begun(model, poses[0], recovery=None), odometry)
    assert error(without[-1], poses[-1]) > 1 and without[-1].verdict != "tracking"


def test_a_place_that_looks_the_same_is_not_forgotten():
    cells = np.pad(np.zeros((50, 90), np.int8), 2, constant_values=100)
    cells[10:14, 20:30] = cells[-14:-10, -30:-20] = 100
    grid = gs.OccupancyGrid(cells, resolution=0.1)
    model = gs.LikelihoodFieldModel(grid, SCANNER, FIELD, backend="opencl")
    poses = along((2.0, 3.0, 0.1), 50, 0.08)
    for seed in range(3):
        pf = gs.ParticleFilter(model, particles=2000, seed=seed)
        pf.initialize_uniform()
        found = track(poses, scans(poses, grid=grid), pf)
        assert {e.verdict for e in found[10:]} == {"uncertain"}, seed
        assert all(e.p_lost > 0.1 for e in found[20:])


def test_the_temperature_does_not_learn_from_a_doubtful_pose(model):
    poses = along((3.0, 4.0, 0.0), 25)
    pf = begun(model, poses[0])
    track(poses[:15], scans(poses[:15]), pf)
    found = []
    for z in scans(along((13.0, 9.5, 0.3), 6, 0.0)):
        pf.predict((0, 0, 0), (0, 0, 0))
        pf.correct(z)
        found.append((pf.estimate().explained, pf.temperatures))
    # The filter drops the first scan elsewhere after judging it.
    doubtful = [after for (explained, before), (_, after) in itertools.pairwise(found) if explained < 0.3]
    assert len(doubtful) > 1 and set(doubtful) == {found[0][1]}


def test_poses_are_drawn_by_their_likelihood():
    rng = np.random.default_rng(0)
    score = -0.5 * rng.normal(size=20_000) ** 2 * 1e4
    rows = drawn(score, 1000, 100)
    assert len(rows) == 1000 and score[rows].min() > -40 * (score.max() - np.sort(score)[-200])
    assert len(np.unique(rows)) > 50
    assert len(np.unique(drawn(score, 1000, 800))) > len(np.unique(rows))
    assert np.array_equal(np.unique(drawn(np.zeros(50), 100, 100)), np.arange(50))
    assert drawn(np.full(10, -np.inf), 5, 100) is None
    score = np.full(1000, -np.inf)
    score[3] = -1e6
    assert set(drawn(score, 20, 100)) == {3}


@pytest.mark.parametrize("kind", ["field", "beam"])
def test_a_carried_robot_is_found_within_a_few_scans(model, kind):
    """The search covers the whole map: neither place nor number of particles matters."""
    if kind == "beam":
        model = gs.BeamModel(GRID, SCANNER, gs.BeamParameters(z_hit=0.8, z_short=0.1, z_max=0.0, z_rand=0.1,
                             sigma_hit=0.05, lambda_short=0.5), backend="opencl")  # fmt: skip
    before, after = along((3.0, 9.5, 0.3), 3), along((13.0, 9.5, 0.3), 10)
    pf = gs.ParticleFilter(model, particles=300, seed=2)
    pf.initialize(mean=before[0], covariance=np.diag([0.01, 0.01, 0.01]))
    odometry = np.vstack([before, before[-1] + after - after[0]])
    found = track(np.vstack([before, after]), scans(np.vstack([before, after])), pf, odometry)
    assert error(found[-1], after[-1]) < 0.2


def test_the_likeliest_poses_of_a_map_hold_the_right_one():
    field = gs.LikelihoodFieldModel(GRID, SCANNER, gs.LikelihoodFieldParameters(sigma_hit=0.15), backend="opencl")
    for pose in ((3.0, 9.5, 0.3), (13.0, 2.5, -2.0), (8.0, 6.0, 3.0)):
        (ranges,) = scans([pose], people=0.3)
        poses = likely_poses(field, ranges, 20)
        off = np.abs(poses - pose)
        near = (off[:, 0] < 0.15) & (off[:, 1] < 0.15) & (np.abs(gs.wrap_angle(poses[:, 2] - pose[2])) < 0.06)
        assert 1 <= len(poses) <= 20 and near.any()
        apart = np.hypot(*(poses[:, None, :2] - poses[None, :, :2]).transpose(2, 0, 1))
        turned = np.abs(gs.wrap_angle(poses[:, None, 2] - poses[None, :, 2]))
        assert ((apart > 0.5) | (turned > 0.26) | np.eye(len(poses), dtype=bool)).all()
    assert likely_poses(field, np.full(90, np.inf), 20).shape == (0, 3)


@pytest.mark.filterwarnings("ignore::gpusense.PlausibilityWarning")
def test_no_pose_is_likelier_than_others_where_a_cell_holds_the_whole_scan():
    """All headings and nearly all cells are equivalent: a search would only list millions of poses."""
    coarse = gs.OccupancyGrid(GRID.cells, 1000.0)
    field = gs.LikelihoodFieldModel(coarse, SCANNER, backend="opencl")
    (ranges,) = scans([(3.0, 9.5, 0.3)])
    assert likely_poses(field, ranges, 20).shape == (0, 3)


def test_a_second_rival_has_nothing_of_the_first(backend, monkeypatch):
    """A state is independent of ended rivals: an earlier copy continues equally."""
    monkeypatch.setattr("gpusense.localization.starts._LEAST_TRIES", 300)
    pf = scene.begun(scene.FILTERS["sensors, resetting"](backend), 4, everywhere=True)
    pf.predict(*scene.odometry(3))
    start, found = pf.state(), []
    for corrections in (1, 2, 1):
        pf.restore(start)
        for _ in range(corrections):
            pf.correct(scene.readings(pf, 3))
        found.append(scene.everything(pf))
    assert found[0] == found[2] != found[1]


def test_scans_of_a_robot_that_stands_count_once_for_a_rival():
    """The same furniture is wrong in all of them; scans far apart count in full."""
    gains = []
    for step in (0.0, 100.0):
        cloud = SimpleNamespace(summary=lambda: SimpleNamespace(evidence=-1.0))
        one = rival.Rival(SimpleNamespace(sensors=[], cloud=cloud, weigh=lambda readings: None))
        for scan in range(20):
            one.correct([], -4.0, np.array([step * scan, 0.0, 0.0]))
        gains.append(one.log_odds - rival.PRIOR)
    assert gains[0] == pytest.approx(3.0 + 19 * 3.0 * 0.05 / 1.95) and gains[1] == pytest.approx(60.0)


def crowded_map(path, tables):
    """Return the building with tables that are not in the scans, none of them on a path."""
    cells, rng = CELLS.copy(), np.random.default_rng(4)
    for row, column in rng.integers(4, (112, 190), (tables, 2)):
        cells[row : row + 4, column : column + 6] = 100
    for x, y, _ in path:
        cells[int(10 * y) - 4 : int(10 * y) + 5, int(10 * x) - 4 : int(10 * x) + 5] = CELLS[int(10 * y), int(10 * x)]
    return gs.OccupancyGrid(cells, resolution=0.1)


def test_a_wrong_map_is_no_evidence_where_no_other_place_fits_better():
    path = along((1.5, 3.0, 0.05), 50, 0.15)
    model = gs.LikelihoodFieldModel(crowded_map(path, 160), SCANNER, FIELD, backend="opencl")
    found = track(path, scans(path), begun(model, path[0]))
    assert max(error(*pair) for pair in zip(found, path, strict=True)) < 0.2
    # Most beams contradict the map. Judged only by beams, the last p_lost was 0.9 and its mean 0.6.
    assert np.median([one.explained for one in found]) < 0.5
    assert found[-1].p_lost < 0.1 and np.mean([one.p_lost for one in found]) < 0.1


def test_a_robot_that_is_carried_away_on_a_wrong_map_is_lost_and_found():
    path, elsewhere = along((1.5, 3.0, 0.05), 20, 0.15), along((14.0, 9.0, 0.5), 12, 0.1)
    model = gs.LikelihoodFieldModel(crowded_map([*path, *elsewhere], 60), SCANNER, FIELD, backend="opencl")
    pf = begun(model, path[0])
    assert track(path, scans(path), pf)[-1].verdict == "tracking"
    carried = track(elsewhere, scans(elsewhere), pf)
    assert max(one.p_lost for one in carried[:4]) > 0.7 and error(carried[-1], elsewhere[-1]) < 0.2


def test_the_comparison_has_the_best_other_place(model):
    """Compare with poses all over the map: the robot's place is the best if the estimate is elsewhere."""
    here, there = np.array([4.0, 3.5, 0.3]), np.array([9.0, 9.0, 2.0])
    ranges, spread = scans([here], people=0.6)[0], np.diag([0.01, 0.01, 0.001])
    anywhere = np.random.default_rng(0).uniform((0, 0, -3), (20, 12, 3), (4000, 3))
    log_p = model.log_likelihood(np.vstack([here, there, anywhere]), ranges)
    search, temperature = RivalSearch([Sensor(model)]), 0.05
    for pose, mine, is_found in ((here, log_p[0], True), (there, log_p[1], False)):
        compared = search.found(pose, spread, [(0, (ranges,))], (0, 0, 0), temperature)
        apart = are_apart(compared.poses, pose)
        best = compared.poses[apart][np.argmax(compared.score[apart])]
        reached = temperature * float(model.log_likelihood(best[None], ranges)[0])
        assert compared.lead == pytest.approx(reached - temperature * float(mine), abs=1e-3)
        assert compared.score[apart].max() == pytest.approx(reached - compared.walls, abs=1e-3)
        assert compared.is_found == is_found and compared.beams == pytest.approx(temperature * SCANNER.count)
        assert compared.ratio < -1.5 if is_found else compared.ratio > 0.2
    # Poses of the search are 0.1 m and 3 degrees apart, and the nearest is slightly less likely.
    others = log_p[are_apart(np.vstack([here, there, anywhere]), there)]
    assert compared.lead > temperature * float(others.max() - log_p[1]) - 1.0 and compared.walls < 0


def test_a_comparison_needs_information_and_has_limits():
    def ratio(lead, beams, walls=-20.0, is_found=False):
        return ratio_of_places(lead, beams, walls, is_found=is_found)

    assert ratio(-math.inf, 10.0) < -2.5 and ratio(math.inf, 10.0) == ratio(9.0, 10.0) > 1
    assert ratio(2.0, 10.0, is_found=True) == pytest.approx(ratio(2.0, 10.0) - IS_FOUND * 10 / 11)
    # A scan with hardly any information is no evidence.
    assert abs(ratio(0.0, 0.01, is_found=True)) < 0.05
    assert math.isnan(ratio(math.nan, 10.0)) and math.isnan(ratio(1.0, 0.0))
    # The lead of a place that its beams contradict is meaningless, and a pose without rival stays right.
    even = math.log((math.exp(ratio(9.0, 10.0)) + 1) / 2)
    assert ratio(9.0, 10.0, walls=0.0) == pytest.approx(even) and 0 < ratio(9.0, 10.0, walls=5.0) < 0.1
    assert ratio(-2.0, 10.0, walls=5.0) == ratio(-2.0, 10.0)
