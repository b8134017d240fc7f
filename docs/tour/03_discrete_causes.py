"""
Causes that depend on each other
================================

A beam moves outwards in small steps. At each step an unknown obstacle, the expected one or chance may trigger a
reading, and the first to trigger hides all others (Fox, Burgard and Thrun, *Markov localization for mobile robots in
dynamic environments*, JAIR 11, 1999). So a far wall is hidden more often than a near one, where the mixture gives the
hits the same share at every distance. **Try:** ``lambda_short=0.6``, a crowd.
"""

import matplotlib.pyplot as plt
import numpy as np

import gpusense as gs

RANGE_MAX, BINS = 5.0, 250
causes = gs.DiscreteCauses(lambda_short=0.25, lambda_rand=0.02, p_detect=0.9, sigma_hit=0.1)
table = gs.DiscreteBeamModel(causes, range_max=RANGE_MAX, bins=BINS)
mixture = gs.DiscreteBeamModel(
    gs.BeamParameters(z_hit=0.6, z_short=0.25, z_max=0.1, z_rand=0.05, sigma_hit=0.1), range_max=RANGE_MAX, bins=BINS
)

z = (np.arange(BINS) + 0.5) * table.width
figure, panels = plt.subplots(2, 1, figsize=(8, 6), sharex=True, sharey=True, layout="constrained")
for ax, one, title in zip(panels, (table, mixture), ("dependent causes", "a mixture"), strict=True):
    for expected, colour in ((1.0, "#0072b2"), (2.5, "#d55e00"), (4.0, "#009e73")):
        row = one.probabilities[int(expected / one.width)]
        ax.plot(z, row[:-1] / one.width, color=colour, label=f"wall at {expected:g} m; no return: {row[-1]:.2f}")
    ax.set(ylabel="density [1/m]", title=title, ylim=(0, 4))
    ax.legend()
panels[-1].set_xlabel("reading z [m]")
plt.show()
