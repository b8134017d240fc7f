"""The verdict of a filter: judged beams, belief that a pose is wrong, spread, and words."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.interface.constants import AGREES, NOTHING, SHORT, THROUGH, VANISHED
from gpusense.localization import belief as constants
from gpusense.localization.beam_consistency import MapJudge
from gpusense.localization.belief import (
    ALIKE,
    ALIKE_CHOSEN,
    FOUND,
    LENGTH,
    LIMITS,
    PER_METRE,
    PER_SCAN,
    STAYS,
    Belief,
    evidence_of_scan,
    ratio_of_scan,
)
from gpusense.localization.spread import share_off, share_off_of, verdict_label

STILL = np.zeros((3, 3))


def house(unknown: bool = False) -> gs.OccupancyGrid:
    """Return a room of 8 m x 6 m with a wall with a door across it at x = 5, and unknown cells around."""
    cells = np.pad(np.zeros((60, 80), int), 1, constant_values=100)
    cells[1:40, 51] = 100
    if unknown:
        cells[:, 52:] = -1
    return gs.OccupancyGrid(np.pad(cells, 5, constant_values=-1), 0.1, (-0.6, -0.6, 0.0))


GRID, POSE = house(), np.array([2.5, 2.0, 0.4])
SCANNER = gs.Scanner.uniform(angle_min=-math.pi, angle_increment=math.tau / 64, count=64, range_max=12.0)


def scan_at(pose, grid=GRID):
    return gs.RayCaster(grid, range_max=12.0, backend="numpy").cast(pose[None], SCANNER.bearings)[0].astype(float)


def consistency(grid, scanner, pose, ranges, *covariance):
    return MapJudge(get_backend("numpy"), grid).consistency(scanner, pose, ranges, *covariance)


def number_of(found, kind):
    return np.count_nonzero(found.kind == kind)


def kinds(pose, ranges, grid=GRID):
    found = consistency(grid, SCANNER, np.asarray(pose, float), np.asarray(ranges, float))
    return [number_of(found, kind) for kind in (AGREES, SHORT, THROUGH, VANISHED, NOTHING)]


def test_beams_of_the_right_pose_agree_and_those_through_walls_do_not():
    ranges = scan_at(POSE)
    agree, short, through, vanished, _ = kinds(POSE, ranges)
    assert agree >= 29 and short == through == vanished == 0
    # 5 cm and 1 degree off are no contradiction, nor is a person.
    assert kinds(POSE + np.array([0.05, 0.0, 0.017]), ranges)[2] == 0
    hidden = ranges.copy()
    hidden[20:40] = 0.6
    agree, short, through, _, _ = kinds(POSE, hidden)
    assert 8 <= short <= 10 and through == 0 and agree >= 19
    # Behind the wall at x = 5 the same scan passes through it.
    elsewhere = kinds(POSE + np.array([3.5, 0.0, 0.0]), ranges)
    assert elsewhere[2] >= 10


def test_no_return_and_missing_readings():
    nothing = np.full(64, np.inf)
    assert kinds(POSE, nothing)[3] >= 29 and kinds(POSE, nothing)[2] == 0
    assert kinds(POSE, np.full(64, np.nan)) == [0, 0, 0, 0, 0]


def test_unknown_cells_and_what_is_off_the_map_tell_nothing():
    ranges = scan_at(POSE, house())
    open_world = house(unknown=True)
    # The beams through the door and over the wall end in unknown cells.
    agree, short, through, _, nothing = kinds(POSE, ranges, open_world)
    assert short == through == 0 and nothing >= 2 and agree >= 20
    off = consistency(GRID, SCANNER, np.array([50.0, 0.0, 0.0]), ranges)
    assert off.off and not off.inside and number_of(off, NOTHING) == len(off.kind)
    inside = consistency(house(), SCANNER, np.array([-0.3, 2.0, 0.0]), ranges)
    assert inside.off
    solid = gs.OccupancyGrid(np.full((40, 40), 100), 0.1)
    assert consistency(solid, SCANNER, np.array([2.0, 2.0, 0.0]), ranges).inside


def test_a_diagonal_pair_of_walls_stops_a_beam():
    cells = np.zeros((60, 60), int)
    cells[np.arange(60), np.arange(59, -1, -1)] = 100
    grid = gs.OccupancyGrid(cells, 0.1)
    rng = np.random.default_rng(0)
    for _ in range(20):
        pose = np.array([*rng.uniform(1.0, 2.0, 2), 0.0])
        scanner = gs.Scanner(rng.uniform(0.3, 1.2, 16), range_max=12.0)
        found = consistency(grid, scanner, pose, np.full(16, 6.0))
        # A ray that leaves the map first meets no wall.
        assert number_of(found, THROUGH) == 16


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (5e6, -3e6, 0.7)])
def test_the_map_may_lie_anywhere_and_be_turned(origin):
    grid = gs.OccupancyGrid(house().cells, 0.1, origin)
    place = gs.compose_poses(np.array(origin), POSE + np.array([0.6, 0.6, 0.0]))
    assert kinds(place, scan_at(POSE), grid) == kinds(POSE, scan_at(POSE))


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("gpu", [False, True], ids=["processor", "GPU"])
def test_every_device_judges_beams_alike(backend, as_gpu, gpu):
    as_gpu(gpu)
    rng = np.random.default_rng(3)
    # Short ranges put only parts of the map on the device.
    for share, side, farthest in ((0.003, 0.05, 12.0), (0.05, 0.3, 12.0), (0.3, 0.1, 12.0), (0.02, 0.3, 2.0)):
        scanner = gs.Scanner(SCANNER.bearings, range_max=farthest)
        cells = np.where(rng.random((70, 50)) < share, 100, 0)
        cells[rng.random(cells.shape) < share / 4] = -1
        grid = gs.OccupancyGrid(cells, side, (-1.0, 2.0, 0.8))
        judge = MapJudge(get_backend(backend), grid)
        low, high = np.array(grid.bounds()).reshape(2, 2)
        for k in range(12):
            pose = np.append(rng.uniform(low - 1, high + 1), rng.uniform(-9, 9)) * (1e12 if k == 5 else 1)
            ranges = rng.choice([np.nan, np.inf, 0.0, *rng.uniform(0.0, 11.0, 9)], 64)
            spread = np.diag(np.square([0.1 * (k % 4), 0.07 * (k % 3), 0.05 * (k % 3)]))
            spread[0, 1] = spread[1, 0] = -0.5 * spread[0, 0] ** 0.5 * spread[1, 1] ** 0.5
            host = consistency(grid, scanner, pose, ranges * farthest / 12, spread)
            device = judge.consistency(scanner, pose, ranges * farthest / 12, spread)
            assert all(np.array_equal(*pair) for pair in zip(host, device, strict=True))


def test_a_scanner_has_its_mount():
    mount = (0.3, -0.1, 1.0)
    turned = gs.Scanner(SCANNER.bearings, range_max=12.0, mount=mount)
    base = gs.compose_poses(POSE, gs.invert_poses(np.array(mount)))
    found = consistency(GRID, turned, base, scan_at(POSE))
    assert number_of(found, AGREES) >= 29


def test_the_ratio_ignores_short_beams_and_has_limits():
    right, hidden = scan_at(POSE), scan_at(POSE)
    hidden[20:40] = 0.6
    one = ratio_of_scan([consistency(GRID, SCANNER, POSE, right)])
    two = ratio_of_scan([consistency(GRID, SCANNER, POSE, hidden)])
    assert one == two == LIMITS[0]
    elsewhere = ratio_of_scan([consistency(GRID, SCANNER, POSE + np.array([3.5, 0.0, 0.0]), right)])
    assert one + 3 < elsewhere <= LIMITS[1]
    assert math.isnan(ratio_of_scan([])) and math.isnan(evidence_of_scan([])[1])
    nothing = consistency(GRID, SCANNER, POSE, np.full(64, np.nan))
    assert math.isnan(ratio_of_scan([nothing])) and math.isnan(evidence_of_scan([nothing])[1])


def test_the_belief_is_the_exact_filter_of_two_states():
    """Compare increments of an autoregressive process of Gaussian ratios with the joint density of all ratios."""
    rng = np.random.default_rng(0)
    for gap in (0.0, 0.5, 2.0):
        # N(+-m, 2 m) is the distribution of ratios of normal data; the distance `gap` between scans sets their
        # correlation.
        rho, mean = STAYS * math.exp(-gap / LENGTH), 1.3
        ratios = rng.normal(mean, math.sqrt(2 * mean), 6)
        covariance = 2 * mean * rho ** np.abs(np.subtract.outer(np.arange(6), np.arange(6)))
        exact = 2 * mean * np.ones(6) @ np.linalg.solve(covariance, ratios)
        belief = Belief(alike=0.0)
        start = belief.log_odds
        for k, ratio in enumerate(ratios):
            belief = belief.judged((gap * k, 0.0, 0.0), float(ratio))
        # Only counted scans cause transitions.
        assert belief.log_odds - start == pytest.approx(exact, abs=1e-9)


def test_comparisons_are_a_second_series_of_the_belief():
    """The joint density of two series of Gaussian ratios, independent of one another given right or wrong."""
    rng, mean, gap = np.random.default_rng(1), 0.8, 0.6
    rho = STAYS * math.exp(-gap / LENGTH)
    root = np.linalg.cholesky(2 * mean * rho ** np.abs(np.subtract.outer(np.arange(5), np.arange(5))))
    ratios = mean + root @ rng.normal(size=(5, 2))
    inverse = np.linalg.inv(root @ root.T)
    exact = 2 * mean * float((np.ones(5) @ inverse @ ratios).sum())
    belief = Belief(alike=0.0)
    start = belief.log_odds
    for k, (scan, comparison) in enumerate(ratios.tolist()):
        pose = (gap * k, 0.0, 0.0)
        belief = belief.judged(pose, scan).compared_with(pose, math.nan).compared_with(pose, comparison)
    assert belief.log_odds - start == pytest.approx(exact, abs=1e-9)
    # Scans fit a place that they have chosen; only contradictions count.
    chosen = Belief.anywhere()
    assert chosen.compared_with((0.0, 0.0, 0.0), -4.0).wrong > 0.45
    assert chosen.compared_with((0.0, 0.0, 0.0), 1.2).wrong > 0.7
    # Likewise for a place after scans without a tracked pose, for any earlier comparison.
    wide = Belief().compared_with((0.0, 0.0, 0.0), 1.2).widened()
    repeated = wide.compared_with((9.0, 9.0, 0.0), -4.0).log_odds - wide.log_odds
    change = ALIKE_CHOSEN + (1 - ALIKE_CHOSEN) * math.exp(-4.0 * (1 - STAYS) / (1 + STAYS))
    assert repeated == pytest.approx(math.log(change))
    # A pose that looks alike also beats other places.
    assert Belief(0.0).compared_with((0.0, 0.0, 0.0), -40.0).log_odds == pytest.approx(math.log(ALIKE))


def test_transitions_of_the_belief():
    belief = Belief().counted().judged((0.0, 0.0, 0.0), math.nan)
    assert belief.wrong == pytest.approx(0.1 * (1 - FOUND) + 0.9 * (1 - math.exp(-PER_SCAN)))
    far = Belief(pose=(0.0, 0.0, 0.0)).counted().counted().judged((2.0, 0.0, 0.0), math.nan)
    stays = 1 - (1 - FOUND) ** 2
    assert far.wrong == pytest.approx(0.1 * (1 - stays) + 0.9 * (1 - math.exp(-2 * PER_SCAN - 2 * PER_METRE)))
    # A standing robot learns almost nothing from its hundredth scan, and a change is detected at once.
    standing = Belief()
    for _ in range(100):
        standing = standing.counted().judged((0.0, 0.0, 0.0), 2.0)
    once = Belief().counted().judged((0.0, 0.0, 0.0), 2.0)
    assert standing.log_odds - once.log_odds < 6
    turned = standing.counted().judged((0.0, 0.0, 0.0), -2.0)
    assert standing.log_odds - turned.log_odds > 1.9


@pytest.mark.parametrize("gap", [0.0, 0.05, 0.3, 1.0])
@pytest.mark.parametrize("before", [-4.0, -1.0, 3.0])
def test_a_pose_that_became_wrong_since_the_last_scan_has_no_earlier_ratio(gap, before) -> None:
    """Bayes' rule for three cases: right, wrong since before, and wrong since the last scan."""
    rho, pose = STAYS * math.exp(-gap / LENGTH), (gap, 0.0, 0.0)
    for ratio in (-4.0, -0.5, 2.0):
        belief = Belief(-2.0, before, (0.0, 0.0, 0.0), alike=0.0).counted()
        wrong, added = belief.wrong, 1 - math.exp(-PER_SCAN - PER_METRE * min(gap, 1.0))
        old = wrong * (1 - FOUND) * math.exp((ratio - rho * before) / (1 + rho))
        rise = max(ratio - before, 0.0) * rho / (1 + rho)
        alike = ALIKE * (1 - rho)
        new = (1 - wrong) * added * (alike + (1 - alike) * math.exp(ratio + rise))
        right = 1 - wrong * (1 - FOUND) - (1 - wrong) * added
        assert belief.judged(pose, ratio).log_odds == pytest.approx(math.log((old + new) / right))


@pytest.mark.parametrize("step", [0.0, 0.005, 0.02, 0.1, 0.5])
def test_agreement_takes_p_lost_below_the_least_risk(step) -> None:
    belief = Belief()
    for k in range(1, 1000):
        belief = belief.counted().judged((step * k, 0.0, 0.1 * step * k), -4.0)
        if step * k > 8:
            assert belief.wrong < 0.005
    # The prior of a standing robot remains, but no scan adds to it.
    assert belief.wrong < ALIKE * 0.1 / 0.9 + 0.001
    # A contradiction raises it at once.
    jumped = belief.counted().judged((step * 1001, 0.0, 0.1 * step * 1001), 3.0)
    assert jumped.wrong > 0.05


def test_agreement_with_a_place_that_scans_have_chosen_is_no_evidence():
    found = Belief.anywhere().counted().widened().counted().judged((0.0, 0.0, 0.0), -3.0)
    assert found.wrong > 0.45
    against = Belief.anywhere().counted().judged((0.0, 0.0, 0.0), 3.0)
    assert against.wrong > 0.9
    moved = found
    for k in range(1, 40):
        moved = moved.counted().judged((0.5 * k, 0.0, 0.0), -3.0)
    assert moved.wrong < 0.05


def test_a_short_log_leaves_places_that_look_alike():
    """Agreement excludes wrong places that differ; similar places remain until the robot has seen more."""
    near = far = Belief.anywhere()
    for k in range(1, 30):
        near = near.counted().judged((0.01 * k, 0.0, 0.0), -4.0)
        far = far.counted().judged((0.6 * k, 0.2 * k, 0.1 * k), -4.0)
    least = ALIKE_CHOSEN / (1 + ALIKE_CHOSEN)
    assert least < near.wrong < 0.35 and far.wrong < 0.4 * least
    # If no scans come between, the share follows Bayes' rule.
    one = Belief(0.0, 0.0, (0.0, 0.0, 0.0)).judged((9.0, 0.0, 0.0), -3.0)
    alike = ALIKE * math.exp(-9.0 / constants.ALIKE_LENGTH)
    assert one.wrong / (1 - one.wrong) == pytest.approx(alike + (1 - alike) * math.exp(one_step(9.0, -3.0)))
    # A pose that looks alike and is contradicted is detected within a few scans.
    for k in range(1, 4):
        near = near.counted().judged((0.3 + 1.0 * k, 0.0, 0.0), 3.0)
    assert near.wrong > 0.85


def one_step(way, ratio):
    """Return the increment of the log odds by a ratio after one of 0."""
    return ratio / (1 + STAYS * math.exp(-way / LENGTH))


def test_the_share_of_a_spread_is_that_of_drawn_poses():
    rng = np.random.default_rng(1)
    for sx, sy, st, turn in ((0.5, 0.5, 0.1, 0.0), (1.0, 0.1, 0.05, 0.6), (0.3, 0.2, 0.3, 1.0), (4.0, 0.01, 0.01, 0.3)):
        c, s = math.cos(turn), math.sin(turn)
        root = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) * (sx, sy, st)
        poses = rng.normal(size=(200_000, 3)) @ root.T
        drawn = share_off_of(poses, np.ones(len(poses)), np.zeros(3))
        assert share_off(root @ root.T) == pytest.approx(drawn, abs=0.004)
    assert share_off(STILL) == 0 and share_off(np.diag([np.inf, 0.01, 0.01])) == 1
    assert share_off(np.diag([21.0**2, 21.0**2, 1.0])) > 0.99
    # Two places, and a pose at one of them.
    two = np.array([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]])
    assert share_off_of(two, np.array([3.0, 1.0]), two[0]) == 0.25


def test_words():
    def word(p_lost, wrong, wide=False, apart=False):
        return verdict_label(p_lost, wrong, wide=wide, apart=apart)

    assert word(0.02, 0.02) == "tracking" and word(0.3, 0.3) == "uncertain" and word(0.7, 0.7) == "lost"
    # A wide cloud is never tracking; contradicted by scans it is lost, unless it covers several places.
    assert word(0.02, 0.01, wide=True) == "uncertain" and word(0.9, 0.8, wide=True) == "lost"
    assert word(1.0, 0.6, wide=True, apart=True) == "uncertain"


@pytest.fixture(scope="module")
def model():
    return gs.LikelihoodFieldModel(GRID, SCANNER, gs.LikelihoodFieldParameters(sigma_hit=0.1), backend="numpy")


def followed(model, poses, scans, **options):
    """Return the estimates of a filter that begins at the first pose."""
    pf, found = gs.ParticleFilter(model, particles=300, seed=1, **options), []
    pf.initialize(mean=poses[0], covariance=np.diag([0.01, 0.01, 0.001]))
    for before, pose, scan in zip([None, *poses], poses, scans, strict=False):
        if before is not None:
            pf.predict(before, pose)
        pf.correct(scan)
        found.append(pf.estimate())
    return pf, found


def circle(count, step=0.15):
    poses = [np.array([2.0, 2.0, 0.0])]
    for _ in range(count - 1):
        poses.append(gs.compose_poses(poses[-1], (step, 0.0, 0.15)))
    return poses


def test_a_carried_robot_is_lost_within_a_few_scans(model):
    poses = circle(20)
    scans = [scan_at(pose if k < 10 else pose + np.array([3.5, 2.0, 1.0])) for k, pose in enumerate(poses)]
    pf, found = followed(model, poses, scans, recovery=None)
    assert all(one.verdict == "tracking" and one.p_lost < 0.05 for one in found[:10])
    assert found[-1].verdict == "lost" and found[-1].lost and found[-1].p_lost > 0.8
    # The evidence names the robot's place.
    told = pf.diagnose()
    assert told.cause == "start" and math.dist(told.elsewhere[:2], (poses[-1] + np.array([3.5, 2.0, 0.0]))[:2]) < 0.3


def test_a_pose_is_judged_at_each_scan_until_it_is_sure_and_then_after_half_a_metre(model):
    monitor, judged = gs.PoseMonitor(model), []
    for pose in circle(60, step=0.08):
        before = monitor.state
        monitor.update(pose, scan_at(pose))
        if monitor.state.judged == monitor.state.corrections:
            judged.append((pose, before.belief.wrong))
    unsure = [wrong > 0.01 for _, wrong in judged]
    first = unsure.index(False)
    assert first > 1 and not any(unsure[first:]) and len(judged) < 30
    for (pose, _), (after, _) in itertools.pairwise(judged[first - 1 :]):
        way, turn = math.dist(pose[:2], after[:2]), abs(gs.wrap_angle(after[2] - pose[2]))
        assert max(way, turn) > 0.49


def test_people_and_a_state_that_is_put_back(model):
    poses, rng = circle(16), np.random.default_rng(3)
    scans = []
    for pose in poses:
        ranges = scan_at(pose)
        first = rng.integers(64)
        ranges[(first + np.arange(30)) % 64] = rng.uniform(0.3, 0.8)
        scans.append(ranges)
    pf, found = followed(model, poses, scans)
    assert all(one.verdict == "tracking" for one in found[1:])
    state = pf._parts.verdict.state
    again = pf.estimate()
    # An estimate judges a correction once.
    assert pf._parts.verdict.state == state and again.p_lost == found[-1].p_lost
    kept = dataclasses.replace(again)
    pf.correct(scan_at(poses[-1] + np.array([3.5, 2.0, 1.0])))
    pf.estimate()
    assert pf._parts.verdict.state != state
    pf._parts.verdict.state = state
    assert kept.p_lost == again.p_lost


def test_a_wide_cloud_is_never_tracked(model):
    pf = gs.ParticleFilter(model, particles=500, seed=1)
    pf.initialize(mean=POSE, covariance=np.diag([1.0, 1.0, 0.01]))
    before = pf.estimate()
    assert before.verdict == "uncertain" and before.p_lost > 0.5 and math.isnan(before.explained)
    pf.initialize_uniform()
    assert pf.estimate().verdict == "uncertain" and pf.estimate().p_lost > 0.9


def test_a_wide_cloud_is_not_compared_with_other_places(model):
    verdict = gs.ParticleFilter(model, particles=500, seed=1)._parts.verdict
    before = verdict.state
    verdict.compared(POSE, np.diag([1.0, 1.0, 0.01]), 1.0)
    assert verdict.state == before
    verdict.compared(POSE, np.diag([0.01, 0.01, 0.001]), 1.0)
    odds = verdict.wrong / (1 - verdict.wrong)
    assert odds == pytest.approx((ALIKE + (1 - ALIKE) * math.e) / 9)


def test_a_compass_has_only_its_spread():
    fix = gs.PositionModel(gs.PositionParameters(sigma=0.1), backend="numpy")
    pf = gs.ParticleFilter(fix, particles=500, seed=1)
    pf.initialize(mean=(0.0, 0.0, 0.0), covariance=np.diag([0.01, 0.01, 1e-4]))
    assert pf.estimate().p_lost < 1e-6 and pf.estimate().verdict == "tracking"
    pf.initialize(mean=(0.0, 0.0, 0.0), covariance=np.diag([4.0, 4.0, 1e-4]))
    assert pf.estimate().p_lost > 0.8 and pf.estimate().verdict == "uncertain"
