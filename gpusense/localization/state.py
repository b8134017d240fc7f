"""Plain data of a particle filter's state, to copy, store, or continue on another device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense.localization.cloud_state import Contents
from gpusense.localization.options import Options
from gpusense.localization.sensors import Sensor


@dataclass(frozen=True, eq=False)
class FilterState:
    """State of a :class:`ParticleFilter`: particles, weights, step, options, and everything learned.

    It holds no device and no models, and pickles. A filter with the same models and options continues from it, after
    ``restore``, with the same bits as the original.

    Attributes:
        options: Keyword arguments of the filter's constructor.
        models: Names of the classes of its models.
        contents: Particles on the host.
        memory: Everything else: learned temperature, recent verdicts, number of the step.

    Example:
        >>> import gpusense as gs, pickle
        >>> model = gs.HeadingModel(backend="numpy")
        >>> pf = gs.ParticleFilter(model, particles=500, seed=1)
        >>> pf.initialize_uniform(bounds=((0.0, 0.0), (5.0, 5.0)))
        >>> state = pickle.loads(pickle.dumps(pf.state()))
        >>> other = gs.ParticleFilter(model, **state.options); other.restore(state); state
        FilterState(500 particles, step=1, models=HeadingModel)
    """

    options: dict[str, Any]
    models: tuple[str, ...]
    contents: Contents
    memory: dict[str, Any]

    def __repr__(self) -> str:
        return f"FilterState({len(self.particles)} particles, step={self.step}, models={', '.join(self.models)})"

    @property
    def particles(self) -> np.ndarray:
        """(N, 3) poses after the last step."""
        return self.contents.poses

    @property
    def weights(self) -> np.ndarray:
        """(N,) normalised weights."""
        return np.asarray(self.contents.weights / self.contents.weights.sum())

    @property
    def step(self) -> int:
        """Number of the last step, a key of random numbers."""
        return int(self.memory["tracker"]["progress"].step)


def constructor_options(options: Options, motion: Any) -> dict[str, Any]:
    """Return the keyword arguments of a filter with these options."""
    rest = options._asdict()
    least, most = rest.pop("least"), rest.pop("most")
    return {"motion": motion, "particles": most if least == most else (least, most), **rest}


def model_names(sensors: Sequence[Sensor]) -> tuple[str, ...]:
    """Return the names of the classes of models."""
    return tuple(type(sensor.model).__name__ for sensor in sensors)


def check_state(state: object, options: dict[str, Any], models: tuple[str, ...]) -> FilterState:
    """Check that a state belongs to a filter with these options and models; the motion model may differ."""
    checked = checks.instance("state", state, FilterState)
    if checked.models != models:
        raise ValueError(f"state: must be of a filter of {', '.join(models)}, got one of {', '.join(checked.models)}")
    for name, value in options.items():
        if name != "motion" and checked.options.get(name) != value:
            raise ValueError(f"state: {name} must be {value!r} as in the filter, got {checked.options.get(name)!r}")
    return checked
