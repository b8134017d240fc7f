"""A particle filter whose particles are split over several devices."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from typing import Any

from gpusense._util import checks
from gpusense.localization.distributed.cloud import SplitCloud
from gpusense.localization.distributed.parts import parts_of
from gpusense.localization.distributed.shard_registry import models_of
from gpusense.localization.distributed.teams import LocalTeam, RemoteTeam
from gpusense.localization.filter import ParticleFilter


class SplitParticleFilter(ParticleFilter):
    """A particle filter over several devices; its particles are the same as on one device.

    Each device moves, scores, weighs and draws its share of the particles. In each stage of a correction the devices
    exchange the largest score, sums of weights, and parents that another device draws. Random numbers depend on a
    particle's index in the whole filter, and sums of weights are exact. So particles and weights equal those of
    :class:`ParticleFilter` on one device of the same kind, bit for bit if log-likelihoods do.

    Args:
        make: Returns the models of a device, given its selection string. With ``executors`` it must be a function of a
            module, or a ``functools.partial`` of one.
        devices: Selection strings, one for each share of the particles; a device may occur more than once.
        executors: One for each device, with one worker that stays the same process: ``ProcessExecutor([device])``, or
            those of ``DaskExecutor.on_each()``; None keeps all shares in this process.
        **options: Options of :class:`ParticleFilter`.

    Raises:
        TypeError, ValueError: an argument breaks its rule; see :class:`ParticleFilter`.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> def make(device):
        ...     return gs.PositionModel(gs.PositionParameters(sigma=0.1), backend=device)
        >>> pf = gs.sweep.SplitParticleFilter(make, devices=["numpy", "numpy"], particles=500, seed=1)
        >>> pf.initialize(mean=(0.5, 0.0, 0.0), covariance=np.diag([0.04, 0.04, 1e-6]))
        >>> pf.correct(np.array([0.6, 0.0]))
        >>> one = gs.ParticleFilter(make("numpy"), particles=500, seed=1)
        >>> one.initialize(mean=(0.5, 0.0, 0.0), covariance=np.diag([0.04, 0.04, 1e-6]))
        >>> one.correct(np.array([0.6, 0.0]))
        >>> np.array_equal(pf.host_particles(), one.host_particles())
        True
    """

    _cloud: SplitCloud

    def __init__(
        self,
        make: Callable[[str], Any],
        *,
        devices: Sequence[str],
        executors: Sequence[Executor] | None = None,
        **options: Any,
    ) -> None:
        if not callable(make):
            raise TypeError(f"make: must be a function of a device, got {checks.show(make)}")
        if isinstance(devices, str) or not devices or not all(isinstance(one, str) for one in devices):
            raise TypeError(f"devices: must be a list of selection strings, got {checks.show(devices)}")
        if executors is not None and len(executors) != len(devices):
            raise ValueError(f"executors: must be one for each of {len(devices)} devices, got {len(executors)}")
        self._make, self._devices, self._executors = make, devices, executors
        super().__init__(models_of(make, devices[0]), **options)

    def _new_cloud(self) -> SplitCloud:
        """Return room for the particles of each device."""
        make, devices, executors = self._make, self._devices, self._executors
        most, count, residual = self.options.most, len(devices), self.options.resampling == "residual"
        # Parts are whole blocks, so the largest part may exceed an equal share.
        share = min(most, most // count + 3 * parts_of(most, count)[0].block)
        team: LocalTeam | RemoteTeam
        if executors is None:
            team = LocalTeam([self.models, *(models_of(make, device) for device in devices[1:])], share, residual)
        else:
            team = RemoteTeam(executors, make, devices, share, residual)
        return SplitCloud(team, most, residual=residual)

    def __repr__(self) -> str:
        return f"Split{super().__repr__()[:-1]}, {self._cloud.explain()})"

    def __getstate__(self) -> dict[str, Any]:
        if self._executors is not None:
            raise TypeError(
                "SplitParticleFilter: must have its shares in this process to be copied or pickled, got executors; "
                "restore its state() in another filter"
            )
        return {"make": self._make, "devices": self._devices, "state": self.state()}

    def __setstate__(self, values: dict[str, Any]) -> None:
        state = values["state"]
        SplitParticleFilter.__init__(self, values["make"], devices=values["devices"], **state.options)
        self.restore(state)

    @property
    def exchanged(self) -> int:
        """Bytes of particles that devices have exchanged."""
        return self._cloud.exchanged

    def close(self) -> None:
        """Release the particles and models of other processes."""
        self._cloud.close()
