"""
Learn a sensor from its readings
================================

Two sensors look at a wall, once 3 m and once 4 m away: a laser, and a sonar that is often disturbed. Maximum
likelihood finds the parameters of each (book section 6.3.2); ``gs.fit_beam_parameters`` does it by expectation and
maximisation with an exact M-step, and Newton's steps at the end. The readings are drawn here, so that the truth is
known. **Try:** 50 readings in place of 1000, and look at the standard errors; `EM step by step
<../../figures/em.html>`__ in the browser.
"""

import matplotlib.pyplot as plt
import numpy as np

import gpusense as gs

RANGE_MAX, WALLS = 5.0, (3.0, 4.0)
SENSORS = {
    "laser": gs.BeamParameters(z_hit=0.93, z_short=0.04, z_max=0.02, z_rand=0.01, sigma_hit=0.03, lambda_short=0.5),
    "sonar": gs.BeamParameters(z_hit=0.5, z_short=0.25, z_max=0.15, z_rand=0.1, sigma_hit=0.12, lambda_short=0.8),
}
cells = np.zeros((1, 101), dtype=np.int8)
cells[0, 100] = 100
grid = gs.OccupancyGrid(cells, resolution=0.05)
poses = [(5.0 - wall, 0.025, 0.0) for wall in WALLS]
scanner = gs.Scanner(np.zeros(1000), range_max=RANGE_MAX)
z = np.linspace(0.005, RANGE_MAX - 0.005, 1000)

figure, panels = plt.subplots(2, 3, figsize=(12, 6), layout="constrained")
for row, (name, truth) in zip(panels, SENSORS.items(), strict=True):
    model = gs.BeamModel(grid, scanner, truth, backend="numpy")
    ranges, expected = model.sample(poses, seed=1), model.expected_ranges(poses)
    fit = gs.fit_beam_parameters(ranges, expected, RANGE_MAX)
    print(name, fit, sep="\n")
    fitted = gs.BeamModel(grid, scanner, fit.parameters, precision="float64", backend="numpy")
    density = np.exp(fitted.log_likelihood(poses, z, per_beam=True)[1])
    for ax, wall, readings, curve in zip(row, WALLS, ranges, density, strict=False):
        ax.hist(readings[readings < RANGE_MAX], bins=200, range=(0, RANGE_MAX), density=False, color="#a6cee3",
                weights=np.full((readings < RANGE_MAX).sum(), 200 / RANGE_MAX / readings.size))  # fmt: skip
        ax.plot(z, curve, color="#d55e00", lw=1)
        ax.set(title=f"{name}, wall at {100 * wall:.0f} cm", xlabel="reading [m]", ylabel="density [1/m]",
               yscale="log", ylim=(5e-3, 30))  # fmt: skip
    row[2].plot(fit.trace - fit.trace[-1], "o-", ms=3, color="#0072b2")
    row[2].set(title=f"{name}: the search", xlabel="iteration", ylabel="log-likelihood - maximum")
plt.show()
