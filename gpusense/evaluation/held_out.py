"""Score held-out readings with fitted parameters and with the defaults of other programs.

Errors within a scan and between neighbouring scans are correlated, so standard errors are computed over blocks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gpusense._util.typing import Floats
from gpusense.evaluation.range_data import RangeData
from gpusense.learning.beam.incidence import IncidenceFit
from gpusense.peers.weights import Beluga
from gpusense.world.parameters import BeamParameters, IncidenceParameters
from gpusense.world.scanner import Reading

# Number of readings that are scored at once.
_BLOCK = 1 << 17


@dataclass(frozen=True)
class HeldOut:
    """Score of held-out readings with one set of parameters.

    Attributes:
        parameters: The parameters, with weights that sum to 1.
        per_beam: Mean log-likelihood of a reading [nats]; -inf if a reading is impossible.
        error: Standard error of ``per_beam``, over blocks.
        gain: Mean log-likelihood of the fitted parameters minus ``per_beam`` [nats]; 0 for the fitted ones. If the
            fitted parameters make a reading impossible, the softened ones replace them.
        gain_error: Standard error of ``gain``, over blocks; NaN for fewer than 2 blocks.
    """

    name: str
    parameters: BeamParameters | IncidenceParameters
    per_beam: float
    error: float
    gain: float
    gain_error: float
    impossible: int


def peer_parameters() -> dict[str, BeamParameters]:
    """Return the defaults of nav2_amcl (also of Beluga's node) and of Beluga's library, with weights that sum to 1."""
    parameters = {}
    for beam, label in ((Beluga.beam, "nav2_amcl's defaults"), (Beluga.library, "Beluga's defaults")):
        values = beam.to_dict()
        total = sum(values[weight] for weight in ("z_hit", "z_short", "z_max", "z_rand"))
        parameters[label] = BeamParameters.from_dict(
            {key: value / total if key.startswith("z_") else value for key, value in values.items()}
        )
    return parameters


def softened(fitted: BeamParameters, readings: int) -> BeamParameters:
    """Return the parameters with half a reading added to each cause (Jeffreys' prior), so that none is impossible."""
    values = fitted.to_dict()
    for name in ("z_hit", "z_short", "z_max", "z_rand"):
        values[name] = (values[name] * readings + 0.5) / (readings + 2)
    return BeamParameters.from_dict(values)


def compare_held_out(
    fitted: BeamParameters,
    data: RangeData,
    *,
    readings: int,
    incidence: IncidenceFit | None = None,
) -> list[HeldOut]:
    """Score held-out readings with fitted parameters and with the defaults of nav2_amcl and Beluga.

    All likelihoods use the book's normalised mixture, not the weights that these programs compute. If the fitted
    parameters make a held-out reading impossible, a row of softened parameters follows, and gains refer to it. The fit
    by angles of incidence is a further row, softened in the same way; its gain is negative if it is better.

    ``incidence``: Fit by angles of incidence, or None; ``data`` then has angles.
    """
    known = data.kinds != Reading.MISSING
    if not known.any():
        raise ValueError("holdout: must hold out a reading that is not missing, got none")
    data = data.chosen(known)
    _, place = np.unique(data.block, return_inverse=True)
    baseline = log_densities(fitted, data)
    scored = [("fitted", fitted, baseline)]
    if np.isneginf(baseline).any():
        soft = softened(fitted, readings)
        baseline = log_densities(soft, data)
        scored.append(("fitted, softened", soft, baseline))
    rows = [_row(*each, baseline, place) for each in scored]
    if incidence is not None:
        rows += _incidence_rows(incidence, data, baseline, place)
    rows += [
        _row(name, parameters, log_densities(parameters, data), baseline, place)
        for name, parameters in peer_parameters().items()
    ]
    return rows


def _row(
    name: str,
    parameters: BeamParameters | IncidenceParameters,
    log_p: Floats,
    baseline: Floats,
    place: NDArray[np.intp],
) -> HeldOut:
    """Return the score of a set of parameters from the readings' log p, the baseline's log p, and their blocks."""
    with np.errstate(invalid="ignore"):
        gain = np.where(baseline == log_p, 0.0, baseline - log_p)
    impossible = int(np.count_nonzero(np.isneginf(log_p)))
    return HeldOut(name, parameters, *block_mean(log_p, place), *block_mean(gain, place), impossible)


def _incidence_rows(fit: IncidenceFit, data: RangeData, baseline: Floats, place: NDArray[np.intp]) -> list[HeldOut]:
    """Return the score of a fit by angles of incidence, and of the softened fit if a reading is impossible."""
    log_p = incidence_log_densities(fit, data)
    rows = [_row("fitted by incidence", fit.parameters, log_p, baseline, place)]
    if np.isneginf(log_p).any():
        bins = zip(fit.parameters.parameters, fit.counts, strict=True)
        parameters = tuple(softened(each, count) for each, count in bins)
        none = fit.parameters.no_surface
        other = None if none is None else softened(none, fit.no_surface_count)
        soft = IncidenceParameters(fit.parameters.edges, parameters, other)
        log_p = incidence_log_densities(replace(fit, parameters=soft), data)
        rows.append(_row("fitted by incidence, softened", soft, log_p, baseline, place))
    return rows


def incidence_log_densities(fit: IncidenceFit, data: RangeData) -> Floats:
    """Return (n,) log p of readings that are not missing, each with the parameters and the fitted offset of its bin.

    A beam that hits no surface has the parameters for such beams or, without them, of the first bin, as in a model.
    """
    assert data.incidence is not None
    edges, bins = fit.parameters.edges, len(fit.parameters.parameters)
    place = np.digitize(data.incidence, edges[1:-1])
    place[np.isnan(data.incidence)] = bins
    sets = [*fit.parameters.parameters, fit.parameters.no_surface or fit.parameters.parameters[0]]
    log_p = np.zeros(len(data.ranges))
    for number, parameters in enumerate(sets):
        log_p[place == number] = log_densities(parameters, data.chosen(place == number))
    return log_p


def log_densities(parameters: BeamParameters, data: RangeData) -> Floats:
    """Return (n,) log p of readings that are not missing: densities [1/m] of ranges, probabilities of no return."""
    from gpusense.models.scan.densities import log_mixture  # loads SciPy

    z, top = data.ranges, data.range_max
    hit = data.kinds == Reading.HIT
    z = np.where(hit, np.clip(z, 0, np.nextafter(top, 0)), top)
    log_p = [
        log_mixture(z[first : first + _BLOCK], data.expected[first : first + _BLOCK], range_max=top,
                    **parameters.to_dict())
        for first in range(0, len(z), _BLOCK)
    ]  # fmt: skip
    return np.concatenate([np.zeros(0), *log_p])


def block_mean(values: Floats, block: NDArray[np.int64]) -> tuple[float, float]:
    """Return the mean of all values and its standard error, as of a ratio of sums over blocks.

    The standard error is NaN for fewer than 2 blocks, or if a value is not finite.
    """
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
