"""
A reading has four causes
=========================

The map says that the wall is at z*. The sensor may report the wall (*hit*), somebody in front of it (*short*),
nothing at all (*max*) or anything (*rand*). The density of a reading is their mixture (book section 6.3.1):

.. math:: p(z \\mid z^*) = z_{hit}\\, p_{hit} + z_{short}\\, p_{short} + z_{max}\\, p_{max} + z_{rand}\\, p_{rand}

``gs.BeamParameters`` has the weights, the deviation of hits and the rate of short readings. **Try:**
``sigma_hit=0.5``, or a wall at 1 m; `with sliders <../../figures/beam.html>`__ in the browser.
"""

import matplotlib.pyplot as plt
import numpy as np

import gpusense as gs

Z_STAR, RANGE_MAX = 3.0, 5.0
ALL = gs.BeamParameters(z_hit=0.6, z_short=0.2, z_max=0.1, z_rand=0.1, sigma_hit=0.15, lambda_short=0.6)

# A wall at z*, and 600 beams that all look at it: each takes another reading.
cells = np.zeros((1, 101), dtype=np.int8)
cells[0, 100] = 100
grid = gs.OccupancyGrid(cells, resolution=0.05)
z = np.linspace(0.004, RANGE_MAX - 0.004, 600)
scanner = gs.Scanner(np.zeros(z.size), range_max=RANGE_MAX)
pose = [(5.0 - Z_STAR, 0.025, 0.0)]


def density(parameters):
    """Return p(z | z*) of each reading [1/m]."""
    model = gs.BeamModel(grid, scanner, parameters, precision="float64", backend="numpy")
    return np.exp(model.log_likelihood(pose, z, per_beam=True)[1][0])


figure, ax = plt.subplots(figsize=(8, 4), layout="constrained")
ax.plot(z, density(ALL), "k", lw=2, label="mixture")
others = {"z_hit": 0.0, "z_short": 0.0, "z_max": 0.0, "z_rand": 0.0}
for name, colour in (("z_hit", "#0072b2"), ("z_short", "#d55e00"), ("z_rand", "#009e73")):
    share = getattr(ALL, name)
    part = share * density(ALL.replace(**(others | {name: 1.0})))
    ax.plot(z, part, "--", color=colour, label=f"{share:g} p_{name[2:]}")
ax.bar(RANGE_MAX, ALL.z_max, width=0.05, color="#cc79a7", label=f"no return: probability {ALL.z_max:g}")
ax.axvline(Z_STAR, color="0.7", lw=1, zorder=0)
ax.set(xlabel="reading z [m]", ylabel="density [1/m]", ylim=(0, None), title=f"A wall at z* = {Z_STAR:g} m")
ax.legend()
plt.show()
