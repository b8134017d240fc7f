"""
The density over the expected range
===================================

The same mixture for every expected range z*: a ridge of hits along z = z*, short readings before it, random ones
everywhere. Mass that a part would have outside [0, range_max] is given back to it, so each column integrates to 1 -
z_max (book section 6.3.1; the book leaves the normalisers to the reader). **Try:** ``lambda_short=0.0``, with which
short readings are uniform.
"""

import matplotlib.pyplot as plt
import numpy as np

import gpusense as gs

RANGE_MAX, COUNT = 5.0, 240
parameters = gs.BeamParameters(z_hit=0.6, z_short=0.2, z_max=0.1, z_rand=0.1, sigma_hit=0.15, lambda_short=0.6)

cells = np.zeros((1, 101), dtype=np.int8)
cells[0, 100] = 100
grid = gs.OccupancyGrid(cells, resolution=0.05)
expected = (np.arange(COUNT) + 1) * RANGE_MAX / COUNT
z = expected - RANGE_MAX / COUNT / 2
poses = np.column_stack([5.0 - expected, np.full(COUNT, 0.025), np.zeros(COUNT)])

model = gs.BeamModel(grid, gs.Scanner(np.zeros(COUNT), RANGE_MAX), parameters, precision="float64", backend="numpy")
density = np.exp(model.log_likelihood(poses, z, per_beam=True)[1])  # rows: expected, columns: measured
mass = density.sum(axis=1) * RANGE_MAX / COUNT
print(f"mass of the columns: {mass.min():.3f} to {mass.max():.3f}, with z_max = {parameters.z_max:g}")

figure, ax = plt.subplots(figsize=(6.4, 5), layout="constrained")
image = ax.imshow(
    density.T,
    origin="lower",
    extent=(0, RANGE_MAX, 0, RANGE_MAX),
    norm="log",
    cmap=gs.plots.colours(),
    interpolation="nearest",
)
ax.set(xlabel="expected range z* [m]", ylabel="reading z [m]", title="p(z | z*)")
figure.colorbar(image, label="density [1/m]")
plt.show()
