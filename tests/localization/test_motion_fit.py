"""Learn the noise of an odometer from logs with reference poses."""

from __future__ import annotations

import numpy as np
import pytest

import gpusense as gs


def test_motion_noise_is_learned():
    rng, alpha, steps = np.random.default_rng(1), np.array([0.02, 0.01, 0.03, 0.005]), 3000
    truth, odometry = [np.zeros(3)], [np.zeros(3)]
    for _ in range(steps):
        one, trans, two = rng.normal(0, 0.3), rng.uniform(0.3, 1.5), rng.normal(0, 0.3)
        noise = rng.normal(size=3) * np.sqrt(
            [alpha[0] * one**2 + alpha[1] * trans**2, alpha[2] * trans**2 + alpha[3] * (one**2 + two**2),
             alpha[0] * two**2 + alpha[1] * trans**2]
        )  # fmt: skip
        odometry.append(_step(odometry[-1], one, trans, two))
        sign = -1 if rng.random() < 0.05 else 1
        truth.append(_step(truth[-1], one + noise[0], sign * (trans + noise[1]), two + noise[2]))
    fit = gs.fit_odometry_motion(np.array(odometry), np.array(truth))
    # Mean squares of 3000 steps have a deviation of 3 %; turns and translations share the noise of a turn.
    assert (np.array(fit.motion.alpha) / alpha)[[0, 1, 2]] == pytest.approx(np.ones(3), rel=0.35)
    assert fit.inflation < 1.8 and 0.03 < fit.motion.reverse < 0.07 and fit.motion.sideways < 0.002
    np.testing.assert_allclose(fit.motion.systematic, 0, atol=0.02)


def test_systematic_errors_and_slips_of_the_odometry_are_learned():
    rng, steps = np.random.default_rng(2), 800
    truth, odometry, missed, slip = [np.zeros(3)], [np.zeros(3)], (0.05, -0.08, 0.06), 0.04
    for _ in range(steps):
        one, trans, two = rng.normal(0, 0.4), rng.choice([0.1, 1.0]), rng.normal(0, 0.4)
        odometry.append(_step(odometry[-1], one, trans, two))
        one, two = (turn * (1 + missed[1]) + missed[2] * trans / 2 + rng.normal(0, 0.02) for turn in (one, two))
        side = rng.normal(0, np.sqrt(slip * (one**2 + two**2)))
        ahead = trans * (1 + missed[0]) + rng.normal(0, 0.03)
        end = gs.compose_poses(truth[-1], (0, 0, one))
        truth.append(gs.compose_poses(end, (ahead, side, two)))
    fit = gs.fit_odometry_motion(np.array(odometry), np.array(truth))
    # Four standard deviations of estimates from 800 steps.
    np.testing.assert_allclose(fit.motion.systematic, missed, atol=0.012)
    assert fit.motion.sideways == pytest.approx(slip, rel=0.3)
    found = fit.motion.sampled(odometry[0], odometry[1])
    assert found.mean[1] == pytest.approx(
        gs.odometry_turns(odometry[0], odometry[1])[1] * (1 + fit.motion.systematic[0])
    )
    plain = gs.fit_odometry_motion(np.array(odometry), np.array(truth), systematic=False).motion
    assert plain.systematic == (0, 0, 0) and plain.alpha[1] > 1.2 * fit.motion.alpha[1]


def _drive(motion, steps, rng):
    """Return odometer poses, and true poses with a model's noise."""
    truth, odometry = [np.zeros(3)], [np.zeros(3)]
    for _ in range(steps):
        odometry.append(_step(odometry[-1], rng.normal(0.1, 0.15), rng.uniform(0, 0.6), rng.normal(0, 0.15)))
        drawn = motion.sampled(*odometry[-2:])
        one, ahead, side, two = np.array(drawn.mean) + rng.normal(size=4) * drawn.deviation
        turned = gs.compose_poses(truth[-1], (0, 0, one))
        truth.append(gs.compose_poses(turned, (ahead, side, two)))
    return np.array(odometry), np.array(truth)


@pytest.mark.long
def test_motion_noise_is_learned_from_references_at_some_steps():
    motion = gs.OdometryMotion((0.03, 0.01, 0.02, 0.005), reverse=0, sideways=0.01, systematic=(0.02, -0.03, 0.02))
    odometry, truth = _drive(motion, 6000, np.random.default_rng(3))
    some = np.full_like(truth, np.nan)
    some[3::17] = truth[3::17]
    fit = gs.fit_odometry_motion(odometry, some)
    assert fit.references == len(odometry[3::17]) and fit.steps == 17 * (fit.references - 1)
    # Gaps determine these variances before the inflation; a step has 1/17 of a gap's variance.
    ratio = np.array(fit.motion.alpha[:3]) / fit.inflation / motion.alpha[:3]
    assert (np.abs(np.log(ratio)) < 3 * np.array(fit.log_errors[:3])).all() and max(fit.log_errors[:3]) < 0.7
    assert "sideways" in fit.undetermined and fit.motion.sideways <= gs.OdometryMotion().sideways
    np.testing.assert_allclose(fit.motion.systematic, motion.systematic, atol=0.03)
    apart = gs.fit_odometry_motion(odometry[3::17], truth[3::17]).motion.alpha
    assert apart[1] < 0.2 * motion.alpha[1]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("jitter", [0.0, 0.0005, 0.003])
def test_motion_noise_of_a_robot_that_stands_stays_near_the_default(jitter):
    rng, moves = np.random.default_rng(0), 10
    odometry, truth = _drive(gs.OdometryMotion(reverse=0), moves, rng)
    place = np.minimum(np.arange(1000) // 90, moves)
    noise = jitter * np.array([1, 1, 0.5])
    odometry, truth = (poses[place] + rng.normal(size=(1000, 3)) * noise for poses in (odometry, truth))
    fit = gs.fit_odometry_motion(odometry, truth)
    default = gs.OdometryMotion()
    assert min(fit.motion.alpha) > 1e-5 and max(fit.motion.alpha) < 0.1 and fit.motion.reverse > 0.005
    assert fit.undetermined and fit.steps == 999 and fit.travelled > 1
    np.testing.assert_allclose(fit.motion.systematic, 0, atol=0.1)
    rest = gs.fit_odometry_motion(odometry[:80] + rng.normal(0, 0.002, (80, 3)), truth[:80])
    assert rest.undetermined[:5] == ("alpha1", "alpha2", "alpha3", "alpha4", "sideways")
    assert rest.motion.alpha == pytest.approx(default.alpha, rel=0.02) and rest.motion.reverse == default.reverse


def _step(pose, one, trans, two):
    return gs.compose_poses(gs.compose_poses(pose, (trans * np.cos(one), trans * np.sin(one), one)), (0, 0, two))
