"""Make the models of a sweep's jobs from their options."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from gpusense._util import checks
from gpusense.evaluation import held_out, range_data
from gpusense.learning.beam.fit import fit_beam_parameters
from gpusense.learning.discrete.causes import DiscreteCauses
from gpusense.learning.discrete.table import DiscreteBeamModel
from gpusense.localization.defaults import DEFAULTS
from gpusense.models.scan.beam import BeamModel
from gpusense.models.scan.field import LikelihoodFieldModel
from gpusense.sweeps.job import Job
from gpusense.sweeps.store import Store
from gpusense.world.parameters import BeamParameters, LikelihoodFieldParameters

if TYPE_CHECKING:
    from gpusense.world.scanner import Scanner

MODELS = ("field", "beam", "discrete")
# Options of a model outside "parameters" and "training".
MODEL_OPTIONS = ("beams", "bins", "fit", "precision", "range_max")
_BINS = 600


def model_of(job: Job, store: Store, scanner: Scanner, *, temperature: float = 1.0) -> Any:
    """Return the model of a job; the worker keeps it.

    A likelihood field has the defaults of ``gpusense localize``, a beam model the defaults of ``BeamParameters``;
    ``parameters.*`` replace them. ``fit: true`` learns a beam model from the logged poses of the scans that
    ``training.*`` choose. A discrete model without parameters is also learned from these scans.

    Args:
        job: The job.
        store: Store of the worker.
        scanner: The scanner of the log.
        temperature: Factor of log-likelihoods.

    Raises:
        TypeError, ValueError: a name or an option breaks its rule.
    """
    checks.choice("model", job.model, MODELS)
    names = {name: job.option(name) for name in MODEL_OPTIONS}
    groups = [tuple(sorted(job.group(name).items())) for name in ("parameters", "training")]
    key = (job.map, job.log, job.model, scanner, temperature, *names.values(), *groups)

    def make() -> Any:
        options: dict[str, Any] = dict(backend=store.device, beams=job.option("beams"), temperature=temperature)
        if job.option("precision") is not None:
            options["precision"] = job.option("precision")
        grid, parameters = store.grid(job.map), _parameters(job, store)
        kind = LikelihoodFieldModel if job.model == "field" else BeamModel
        return kind(grid, scanner, parameters, **options)

    return store.keep("models", key, make)


def _parameters(job: Job, store: Store) -> Any:
    values = job.group("parameters")
    if job.model == "field":
        return LikelihoodFieldParameters(**{**DEFAULTS.field, **values})
    learned = job.option("fit", False) if job.model == "beam" else not values
    if not learned:
        if job.model == "beam":
            return BeamParameters(**values)
        range_max = store.scans(job, "training")[0][1].scanner.range_max
        return DiscreteBeamModel(DiscreteCauses(**values), range_max, job.option("bins", _BINS))
    if values:
        raise ValueError(f"parameters: must be none where they are learned, got {checks.show(values)}")
    data = range_data.data_of_log(store.grid(job.map), store.scans(job, "training"), backend=store.device)
    if job.model == "discrete":
        return DiscreteBeamModel.learn(data.ranges, data.expected, data.range_max, job.option("bins", _BINS))
    fit = fit_beam_parameters(data.ranges, data.expected, data.range_max, backend=store.device)
    return held_out.softened(fit.parameters, fit.hits + fit.max_readings)
