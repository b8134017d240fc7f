"""Scenes of known parameters, from mild to stiff, that tests and benchmarks fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpusense.evaluation.worlds import sample_readings
from gpusense.world.parameters import BeamParameters


@dataclass(frozen=True)
class Scene:
    """Known parameters and an interval of expected ranges.

    Attributes:
        name: Number, span and hardness.
        parameters: Parameters for drawing readings.
        range_max: Longest range [m].
        span: Interval of the expected ranges, as shares of range_max; they are uniform there.
    """

    name: str
    parameters: BeamParameters
    range_max: float
    span: tuple[float, float]

    def draw(self, count: int, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Draw readings and expected ranges, (count,) each [m]."""
        expected = rng.uniform(*self.span, count) * self.range_max
        return sample_readings(expected, self.range_max, self.parameters, rng), expected


_SPANS = {"near": (0.01, 0.2), "even": (0.02, 0.98), "far": (0.8, 1.0), "one range": (0.5, 0.5)}


def learning_scenes(count: int = 50, seed: int = 0) -> list[Scene]:
    """Make scenes of rising hardness: weights down to 0.5 %, sigma and lambda over decades, narrow spans of z*.

    Args:
        count: Number of scenes.
        seed: Seed of their parameters.
    """
    rng = np.random.default_rng(seed)
    scenes = []
    for i in range(count):
        hard = i / max(count - 1, 1)
        range_max = float(np.exp(rng.uniform(np.log(3), np.log(80))))
        weights = rng.dirichlet(np.array([6.0, 1.5, 1.0, 1.5]) * (1 - 0.6 * hard) + 0.3) + 0.005
        weights /= weights.sum()
        middle = np.log([0.01 * range_max, 3 / range_max])
        spread = np.array([0.5 + 2.0 * hard, 0.3 + 1.2 * hard])
        sigma, rate = np.exp(middle + spread * rng.uniform(-1, 1, 2))
        span = list(_SPANS)[i % 4] if hard > 0.3 else "even"
        hit, short, top, rand = weights.tolist()
        parameters = BeamParameters(hit, short, top, rand, float(sigma), float(rate))
        scenes.append(Scene(f"{i}: {span}, hardness {hard:.2f}", parameters, range_max, _SPANS[span]))
    return scenes
