"""Combine a laser, a compass, a position fix and a bumper, each of them vague."""

import numpy as np

import gpusense as gs

rng = np.random.default_rng(7)
grid = gs.worlds.building()

# A small laser, and models of four sensors. Sensors are independent given the pose, so their log-likelihoods add up.
scanner = gs.Scanner(np.linspace(-np.pi, np.pi, 12, endpoint=False), range_max=4.0)
noise = gs.BeamParameters(z_hit=0.9, z_short=0.03, z_max=0.02, z_rand=0.05, sigma_hit=0.05, lambda_short=0.5)
field = gs.LikelihoodFieldParameters(z_hit=0.8, z_rand=0.2, sigma_hit=0.15)
laser = gs.LikelihoodFieldModel(grid, scanner, field, temperature=0.8)
compass = gs.HeadingModel(gs.HeadingParameters(sigma=0.2, z_hit=0.9, z_rand=0.1))
fix = gs.PositionModel(gs.PositionParameters(sigma=2.0, z_hit=0.9, z_rand=0.1, region=(0.0, 0.0, 30.0, 20.0)))
bumper = gs.BumperModel(grid, 0.25, gs.BumperParameters(p_contact=0.95, p_false=0.001, sigma=0.02))

# A true pose at which the robot touches an obstacle, and its measurements there.
poses = gs.worlds.cloud_uniform(grid, 200_000, rng)
touching = poses[np.argmax(bumper.log_likelihood(poses, True) > np.log(0.9))]
truth = np.array([touching[0], touching[1], 0.7])
measured = {
    "bumper": (bumper, True),
    "compass": (compass, truth[2] + rng.normal(0, 0.2)),
    "position fix": (fix, truth[:2] + rng.normal(0, 2.0, 2)),
    "laser": (laser, gs.worlds.simulate_scan(grid, scanner, truth, noise, rng)),
}


def spread(log_p: np.ndarray) -> str:
    """Return the weighted medians of the errors of position and heading, and the effective number of particles."""
    weights = np.exp(log_p - log_p.max())
    weights /= weights.sum()
    distances = np.hypot(*(poses[:, :2] - truth[:2]).T)
    turns = np.abs(np.angle(np.exp(1j * (poses[:, 2] - truth[2]))))
    position, heading = (
        errors[order[np.searchsorted(np.cumsum(weights[order]), 0.5)]]
        for errors, order in ((distances, np.argsort(distances)), (turns, np.argsort(turns)))
    )
    return f"{position:6.2f} m {np.degrees(heading):7.1f} deg {1 / (weights @ weights):10.0f}"


print(f"{'':24}{'position':>8} {'heading':>11} {'effective particles':>20}")
total = np.zeros(len(poses))
for name, (model, reading) in measured.items():
    log_p = model.log_likelihood(poses, reading)
    total += log_p
    print(f"{name + ' alone':24}{spread(log_p)}")
    print(f"{'... and all above':24}{spread(total)}")
best = poses[np.argmax(total)]
print("the best pose is", best.round(2), "and the truth", truth.round(2))
