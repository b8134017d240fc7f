"""Geometry with no, two, or infinitely many positions is named, with all determined quantities."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.position_scenes import CASES

import gpusense as gs
from gpusense.positions.fix import STATUSES

SQUARE = np.array([(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0)])
LINE = np.array([(0.0, 0.0), (1.0, 0.5), (4.0, 2.0), (6.0, 3.0)])
UTM = np.array([5e6, 4.5e5])
# All statuses survive moving a scene.
PLACES = {
    "here": lambda xy: xy,
    "far and turned": lambda xy: xy @ np.array([(0.6, 0.8), (-0.8, 0.6)]) * 8.0 + UTM,
}
placed = pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)


def ranges_to(xy, point):
    return np.hypot(*(xy - point).T)


def bearings_to(xy, pose):
    return np.arctan2(xy[:, 1] - pose[1], xy[:, 0] - pose[0]) - pose[2]


def near(fix, *points, atol=1e-6):
    np.testing.assert_allclose(fix.solutions, points, rtol=0, atol=atol)
    return True


@pytest.mark.parametrize(
    ("ranges", "sigma", "status", "point"),
    [
        ((1.0, 3.0), None, "tangent", (1.0, 0.0)),
        ((0.0, 4.0), None, "tangent", (0.0, 0.0)),
        ((7.0, 3.0), None, "tangent", (7.0, 0.0)),
        ((1.0, 1.0), None, "disjoint", (2.0, 0.0)),
        ((1.0, 1.0), (2.0, 1.0), "disjoint", (2.6, 0.0)),
        ((0.0, 0.0), None, "disjoint", (2.0, 0.0)),
        ((8.0, 2.0), None, "contained", (7.0, 0.0)),
        ((2.0, 8.0), None, "contained", (-3.0, 0.0)),
        ((8.0, 2.0), (1.0, 2.0), "contained", (7.6, 0.0)),
    ],
)
@placed
def test_two_circles_that_do_not_cross(place, ranges, sigma, status, point):
    """The nearest point on the line of centres divides the gap in proportion to the variances."""
    xy = place(SQUARE[:2])
    factor = np.hypot(*(xy[1] - xy[0])) / 4
    fix = gs.trilaterate(xy, np.array(ranges) * factor, sigma=sigma)
    assert (fix.status, fix.degenerate, len(fix)) == (status, True, 1)
    assert near(fix, place(np.array([point]))[0]) and np.isnan(fix.covariance).all() and np.isinf(fix.condition).all()


@placed
def test_beacons_at_one_place(place):
    twice, thrice = place(SQUARE[[1, 1]]), place(SQUARE[[1, 1, 1]])
    empty = [
        gs.trilaterate(twice, [2.0, 2.0]),
        gs.trilaterate(twice, [2.0, 3.0]),
        gs.trilaterate(thrice, [2.0, 2.0, 2.0]),
        gs.triangulate(twice, [0.1, 0.1], 0.0),
        gs.triangulate(place(SQUARE[[0, 0, 1]]), [0.1, 0.1, 0.5]),
        gs.triangulate_triangle(place(SQUARE[[0, 1, 1]]), [0.1, 0.3, 0.5]),
        gs.locate(twice, [2.0, 2.0], [0.1, 0.1], sigma_range=0.1, sigma_bearing=0.1),
    ]
    for fix in empty:
        assert (fix.status, fix.degenerate, len(fix)) == ("coincident", True, 0)
        with pytest.raises(ValueError, match="solutions: must hold one, got none: coincident: too few"):
            _ = fix.best
    # Other beacons make the fix regular.
    xy = place(SQUARE[[0, 1, 1, 2]])
    point = place(np.array([(1.0, 2.5)]))[0]
    fix = gs.trilaterate(xy, ranges_to(xy, point))
    assert fix.status == "unique" and near(fix, point)


@placed
@pytest.mark.parametrize("beacons", [(0, 2), (0, 0, 3), (0, 1, 2), (3, 0, 1, 2)], ids=str)
def test_beacons_in_line_leave_the_mirror_image(place, beacons):
    xy = place(LINE[list(beacons)])
    point, image = place(np.array([(1.0, 3.0), (3.0, -1.0)]))
    fix = gs.trilaterate(xy, ranges_to(xy, point), sigma=0.1)
    assert fix.status == ("two" if len(beacons) == 2 else "mirror") and not fix.degenerate
    first = np.argmin(ranges_to(fix.solutions, point))
    assert near(fix, *[(point, image), (image, point)][first])
    # The covariances of the images are also mirrored.
    np.testing.assert_allclose(np.linalg.eigvalsh(fix.covariance[0]), np.linalg.eigvalsh(fix.covariance[1]), rtol=1e-6)


@placed
@pytest.mark.parametrize("point", [(2.0, 1.0), (-2.0, -1.0), (0.0, 0.0), (4.0, 2.0)], ids=str)
def test_a_robot_in_line_with_its_beacons(place, point):
    xy, robot = place(LINE), place(np.array([point]))[0]
    fix = gs.trilaterate(xy, ranges_to(xy, robot))
    assert fix.status == ("at a beacon" if point in ((0.0, 0.0), (4.0, 2.0)) else "in line")
    assert fix.degenerate and near(fix, robot) and np.isnan(fix.covariance).all()
    # Ranges that are all too short also put the robot onto the line.
    if point == (2.0, 1.0):
        fix = gs.trilaterate(xy, 0.8 * ranges_to(xy, robot))
        assert fix.status == "in line" and fix.degenerate


def test_ranges_at_a_beacon():
    fix = gs.trilaterate(SQUARE, ranges_to(SQUARE, SQUARE[2]))
    assert fix.status == "at a beacon" and not fix.degenerate and near(fix, SQUARE[2])
    assert np.isfinite(fix.covariance).all()


def test_noise_that_hides_which_side():
    """Beacons 1 cm off a line: ranges with errors of 1 mm determine the side, errors of 10 cm leave both."""
    xy = LINE + np.array([(0, 0), (-0.01, 0.02), (0.01, -0.02), (0, 0)])
    ranges = ranges_to(xy, (1.0, 3.0))
    fine, coarse, unknown = (gs.trilaterate(xy, ranges, sigma=sigma) for sigma in (0.001, 0.1, None))
    assert fine.status == unknown.status == "unique" and coarse.status == "ambiguous"
    assert len(coarse) == 2 and coarse.cost[1] - coarse.cost[0] < 9
    for fix in (fine, coarse, unknown):
        np.testing.assert_allclose(fix.best, (1.0, 3.0), atol=1e-7)


@placed
def test_lines_of_sight_that_do_not_meet(place):
    xy = place(SQUARE[:2])
    along = math.atan2(*(xy[1] - xy[0])[::-1])
    # All of: heading along the beacons' line, and bearings.
    for bearings, status in [
        ((0.5, 0.5), "parallel"),
        ((0.5, 0.5 - math.pi), "parallel"),
        ((0.0, 0.0), "in line"),
        ((math.pi, 0.0), "in line"),
        ((1e-9, -1e-9), "behind"),
        ((-0.5, 0.5), "behind"),
        ((0.3, 0.9), "behind"),
    ]:
        fix = gs.triangulate(xy, bearings, along)
        assert (fix.status, fix.degenerate, len(fix)) == (status, True, 0), bearings
    # The robot is between two beacons: one behind on the left, one ahead on the left.
    assert gs.triangulate(xy, (3.0, 0.5), along).status == "unique"
    assert gs.triangulate(place(SQUARE[:3]), [0.5, 0.5, 0.5], 0.0).status == "parallel"


@placed
@pytest.mark.parametrize("turn", [0.3, 2.0, 4.0, 5.2])
def test_a_robot_on_the_circle_through_its_beacons(place, turn):
    centre, radius = np.array([2.0, 2.0]), math.sqrt(8.0)
    robot = place(centre + radius * np.array([(math.cos(turn), math.sin(turn))]))[0]
    for count in (3, 4):
        xy = place(SQUARE[:count])
        bearings = bearings_to(xy, (*robot, 0.7))
        fixes = [gs.triangulate(xy, bearings)]
        if count == 3:
            fixes.append(gs.triangulate_triangle(xy, bearings))
        for fix in fixes:
            assert (fix.status, fix.degenerate, len(fix)) == ("circle", True, 0)
    # A heading, or a beacon off the circle, removes the ambiguity.
    xy = place(SQUARE)
    theta = 0.7
    assert near(gs.triangulate(xy, bearings_to(xy, (*robot, theta)), theta), robot, atol=1e-5)
    xy = place(np.vstack([SQUARE, (9.0, 1.0)]))
    fix = gs.triangulate(xy, bearings_to(xy, (*robot, theta)))
    assert fix.status == "unique" and near(fix, (*robot, theta), atol=1e-5)


@placed
def test_three_bearings_in_bad_places(place):
    line = place(LINE[:3])
    # In line with all beacons, bearings are equal at every point of the line.
    robot = place(np.array([(-2.0, -1.0)]))[0]
    fix = gs.triangulate_triangle(line, bearings_to(line, (*robot, 0.4)))
    assert (fix.status, len(fix)) == ("in line", 0)
    # Seen from off their line, beacons are not degenerate.
    robot = place(np.array([(1.0, 3.0)]))[0]
    fix = gs.triangulate_triangle(line, bearings_to(line, (*robot, 0.4)))
    assert fix.status == "unique" and near(fix, (*robot, 0.4), atol=1e-5)
    # Equal bearings put the robot in line with two beacons, and the third beacon determines its position.
    xy = place(SQUARE[:3])
    robot = place(np.array([(-3.0, 0.0)]))[0]
    fix = gs.triangulate_triangle(xy, bearings_to(xy, (*robot, -1.0)))
    assert fix.status == "unique" and near(fix, (*robot, -1.0), atol=1e-5)
    # No pose has equal bearings of three beacons that are not in line.
    assert gs.triangulate_triangle(xy, (0.2, 0.2, 0.2)).status == "behind"
    # Beacons in the wrong order around the robot.
    inside = bearings_to(xy, (*place(np.array([(3.0, 1.5)]))[0], 0.0))
    assert gs.triangulate_triangle(xy, -inside).status in ("behind", "unique")
    # At a beacon the other two, and any bearing of this one, determine the pose.
    others = bearings_to(xy[1:], (*xy[0], 0.3))
    for any_bearing in (0.5, -2.0):
        fix = gs.triangulate_triangle(xy, [any_bearing, *others])
        assert fix.status == "at a beacon"
        assert near(fix, (*xy[0], fix.best[2]), atol=1e-5)


def test_poses_that_see_beacons_behind_their_bearings():
    """For random bearings, "behind" is reported exactly if no pose of a fine lattice has similar ones."""
    rng = np.random.default_rng(2)
    places = np.stack(np.meshgrid(*[np.linspace(-30, 34, 257)] * 2), axis=-1).reshape(-1, 2)
    seen = np.arctan2(SQUARE[:3, 1] - places[:, 1:], SQUARE[:3, 0] - places[:, :1])
    words = []
    for _ in range(60):
        bearings = rng.uniform(-np.pi, np.pi, 3)
        fix = gs.triangulate_triangle(SQUARE[:3], bearings)
        words.append(fix.status)
        turn = seen - bearings
        spread = np.abs(np.angle(np.exp(1j * (turn - turn[:, :1]))))[:, 1:].max(axis=1)
        if fix.status == "behind":
            # Near a beacon its bearing turns fast, so that lattice points there prove nothing.
            clear = np.min([ranges_to(places, m) for m in SQUARE[:3]], axis=0) > 1.5
            far = np.hypot(*(places - 2.0).T) < 20
            assert spread[clear & far].min() > 0.01
        else:
            np.testing.assert_allclose(
                np.angle(np.exp(1j * (bearings_to(SQUARE[:3], fix.best) - bearings))), 0, rtol=0, atol=1e-9
            )
    assert words.count("behind") > 5 and words.count("unique") > 5


@placed
def test_scenes_on_a_small_lattice(place):
    """On few lattice points, beacons and robots often coincide, are in line, or share circles. In every noiseless
    scene, the truth is among the solutions, or the fix is degenerate, or the robot is at a beacon with a made-up
    bearing.
    """
    rng = np.random.default_rng(3)
    seen = set()
    for k in range(240):
        case = CASES[k % len(CASES)]
        xy, robot = place(rng.integers(-1, 2, (case.beacons, 2)) * 1.0), place(rng.integers(-1, 2, (1, 2)) * 1.0)[0]
        theta = float(rng.choice([0.0, 0.5, np.pi, -3.0]))
        sigma = case.sigmas(case.beacons) if case.kind == "both" else None
        fix = case.solve(xy, case.measure(xy, (*robot, theta)), theta, sigma=sigma)
        seen.add(fix.status)
        assert fix.status in STATUSES and fix.status not in ("parallel", "disjoint", "contained")
        assert fix.degenerate or np.isfinite(fix.covariance[0]).all()
        if fix.degenerate or ranges_to(xy, robot).min() < 1e-6:
            continue
        # UTM coordinates are rounded to 1e-9 m, which the condition number magnifies.
        assert ranges_to(fix.solutions[:, :2], robot).min() < 1e-7 * max(1.0, fix.condition[0]), (
            case.name,
            xy,
            robot,
            fix,
        )
    assert seen >= {"unique", "two", "mirror", "coincident", "at a beacon", "in line", "circle"}


def test_every_status_is_explained():
    for status in STATUSES:
        assert STATUSES[status] and "\n" not in STATUSES[status]
    assert gs.trilaterate(SQUARE[:2], [3.0, 3.0]).explain() == "two: two circles cross: both points fit equally well"
