"""How likely held-out readings are with fitted parameters, beside the defaults of other programs.

Readings of one scan err together, and so do those of neighbouring scans: standard errors are those of blocks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpusense.evaluation.range_data import RangeData
from gpusense.world.compat import PEERS
from gpusense.world.parameters import BeamParameters
from gpusense.world.scanner import Reading

Floats = NDArray[np.float64]

# Readings that are scored at once.
_BLOCK = 1 << 17


@dataclass(frozen=True)
class HeldOut:
    """How likely held-out readings are with some parameters, beside the fitted ones.

    Attributes:
        name: Whose parameters.
        parameters: They, with weights that sum to 1.
        per_beam: Mean log-likelihood of a reading [nats]; -inf where one is impossible.
        error: Its standard error, by blocks.
        gain: Mean by which the fitted parameters make a reading likelier [nats]; 0 for the fitted ones. Where these
            make a reading impossible it is that of the softened ones.
        gain_error: Its standard error, by blocks; NaN where there are fewer than 2.
        impossible: Readings that are impossible.
    """

    name: str
    parameters: BeamParameters
    per_beam: float
    error: float
    gain: float
    gain_error: float
    impossible: int


def peer_parameters() -> dict[str, BeamParameters]:
    """Default parameters of nav2_amcl and Beluga, their weights divided by their sums, which are not 1."""
    found = {}
    for name, label in (("amcl", "nav2_amcl's defaults"), ("beluga", "Beluga's defaults")):
        values = PEERS[name].beam.to_dict()
        total = sum(values[weight] for weight in ("z_hit", "z_short", "z_max", "z_rand"))
        found[label] = BeamParameters.from_dict(
            {key: value / total if key.startswith("z_") else value for key, value in values.items()}
        )
    return found


def softened(fitted: BeamParameters, readings: int) -> BeamParameters:
    """Fitted parameters as if each cause had been seen half a time more, so that none is impossible (Jeffreys)."""
    values = fitted.to_dict()
    for name in ("z_hit", "z_short", "z_max", "z_rand"):
        values[name] = (values[name] * readings + 0.5) / (readings + 2)
    return BeamParameters.from_dict(values)


def compare_held_out(
    fitted: BeamParameters, data: RangeData, *, readings: int, range_bias: float = 0.0
) -> list[HeldOut]:
    """Held-out readings with fitted parameters, and with the defaults of nav2_amcl and Beluga.

    All are likelihoods by the book's normalised mixture, not the weights that these programs compute. Where the fitted
    parameters make a held-out reading impossible, softened ones follow them, with which the others are compared.

    Args:
        fitted: Parameters that these readings had no part in.
        data: The readings.
        readings: How many the parameters were fitted to.
        range_bias: Offset that was fitted with them, taken from the readings before they are scored [m].

    Raises:
        ValueError: every reading is missing.
    """
    known = data.kinds != Reading.MISSING
    if not known.any():
        raise ValueError("holdout: must hold out a reading that is not missing, got none")
    data = data.chosen(known)
    _, place = np.unique(data.block, return_inverse=True)
    candidates = {"fitted": fitted}
    own = log_densities(fitted, data, range_bias)
    if np.isneginf(own).any():
        candidates["fitted, softened"] = softened(fitted, readings)
        own = log_densities(candidates["fitted, softened"], data, range_bias)
    rows = []
    for name, parameters in {**candidates, **peer_parameters()}.items():
        log_p = log_densities(parameters, data, range_bias if name in candidates else 0.0)
        with np.errstate(invalid="ignore"):
            gain = np.where(own == log_p, 0.0, own - log_p)
        mean, gained = block_mean(log_p, place), block_mean(gain, place)
        rows.append(HeldOut(name, parameters, *mean, *gained, int(np.count_nonzero(np.isneginf(log_p)))))
    return rows


def log_densities(parameters: BeamParameters, data: RangeData, range_bias: float = 0.0) -> Floats:
    """(n,) log p of readings that are not missing: densities [1/m], probabilities of no return."""
    from gpusense.models.scan.densities import log_mixture  # loads SciPy

    z, top = data.ranges, data.range_max
    hit = data.kinds == Reading.HIT
    z = np.where(hit, np.clip(z - range_bias, 0, np.nextafter(top, 0)), top)
    found = [
        log_mixture(z[first : first + _BLOCK], data.expected[first : first + _BLOCK], range_max=top,
                    **parameters.to_dict())
        for first in range(0, len(z), _BLOCK)
    ]  # fmt: skip
    return np.concatenate([np.zeros(0), *found])


def block_mean(values: Floats, block: NDArray[np.int64]) -> tuple[float, float]:
    """Mean of all values and its standard error, that of a ratio of sums over blocks; NaN for fewer than 2 blocks."""
    if not np.isfinite(values).all():
        with np.errstate(invalid="ignore"):
            return float(values.sum()), math.nan
    counts, sums = np.bincount(block).astype(float), np.bincount(block, values)
    mean = float(sums.sum() / counts.sum())
    blocks = len(counts)
    if blocks < 2:
        return mean, math.nan
    off = sums - mean * counts
    return mean, float(math.sqrt(blocks / (blocks - 1) * float(off @ off)) / counts.sum())
