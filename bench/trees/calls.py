"""Time calls of one version of gpusense on request: the child of speed.py.

It uses only NumPy and the public interface, so it runs with any version of the package on the path. Arguments are the
file of arrays that the parent wrote, and a backend. The first line of standard output describes package and device and
lists the rows. Each line of standard input is then a request, which is answered by one line:

- ``{"row": LABEL, "calls": 0}`` prepares a row and runs two calls: seconds of the second one, and a digest of the bits
    of its result;
- ``{"row": LABEL, "calls": N}`` runs that many calls of the prepared row, after one that is not counted: seconds of the
    shortest.
"""

from __future__ import annotations

import functools
import hashlib
import json
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import gpusense as gs

# The default of the field's parameters differs between versions.
MODELS = {
    "field": functools.partial(gs.LikelihoodFieldModel, parameters=gs.LikelihoodFieldParameters()),
    "beam model": gs.BeamModel,
}
# Number of bound calls between waits.
IN_A_ROW = 20


class Host:
    """NumPy arrays; calls with them block."""

    label = ""

    def __init__(self, selection: str) -> None:
        self.backend: Any = selection

    def array(self, values: np.ndarray) -> Any:
        """Copy an array."""
        return values.copy()

    def wait(self) -> None:
        """Do nothing, since calls block."""

    def read(self, array: Any) -> np.ndarray:
        """Return an array's values."""
        return np.asarray(array)


class OpenCL(Host):
    """Arrays of pyopencl on a queue of a GPU."""

    label = ", on the device"

    def __init__(self, selection: str) -> None:
        import pyopencl as cl
        import pyopencl.array

        _, platform, device = selection.split(":")
        self._array = cl.array
        self.backend = cl.CommandQueue(cl.Context([cl.get_platforms()[int(platform)].get_devices()[int(device)]]))

    def array(self, values: np.ndarray) -> Any:
        """Copy an array to the device."""
        return self._array.to_device(self.backend, values)

    def wait(self) -> None:
        """Wait for all commands."""
        self.backend.finish()

    def read(self, array: Any) -> np.ndarray:
        """Copy an array to the host."""
        return np.asarray(array.get())


class Warp(Host):
    """Arrays of Warp on a GPU."""

    label = ", on the device"

    def __init__(self, selection: str) -> None:
        import warp as wp

        super().__init__(selection)
        self._warp, self._device = wp, wp.get_device(selection.removeprefix("warp:"))

    def array(self, values: np.ndarray) -> Any:
        """Copy an array to the device."""
        dtype = {"float32": self._warp.float32, "float64": self._warp.float64}[values.dtype.name]
        return self._warp.array(values, dtype=dtype, device=self._device)

    def wait(self) -> None:
        """Wait for all launches and copies."""
        self._warp.synchronize_device(self._device)

    def read(self, array: Any) -> np.ndarray:
        """Copy an array to the host."""
        return np.asarray(array.numpy())


# Particles of filters.
FILTERS = (500, 4000)

# Prepares a row: a function that runs calls and waits, the result, and the number of calls.
Ready = tuple[Callable[[], Any], Callable[[], np.ndarray], int]


class Rows:
    """The rows of a device.

    Attributes:
        info: The device, as a model describes it.
        makers: Functions that prepare the rows, by label.
    """

    def __init__(self, arrays: dict[str, np.ndarray], selection: str) -> None:
        self._arrays = arrays
        self._range_max = float(arrays["range_max"])
        self.grid = gs.OccupancyGrid(arrays["cells"], float(arrays["resolution"]))
        self.info = gs.RayCaster(gs.OccupancyGrid([[0]], 1.0), 1.0, backend=selection).device
        places: list[Host] = [Host(self.info.selection)]
        if self.info.kind == "gpu":
            places.append((OpenCL if self.info.backend == "opencl" else Warp)(self.info.selection))
        self.makers: dict[str, Callable[[], Ready]] = {}
        clouds = {name: arrays[name] for name in ("global", "tracking")}
        for place in places:
            for name, poses in clouds.items():
                size = f"{name}, {len(poses)} x {len(arrays['bearings'])}{place.label}"
                self.makers[f"rays, {size}"] = functools.partial(self._cast, place, poses)
                for model in MODELS:
                    self.makers[f"{model}, {size}"] = functools.partial(self._score, place, model, poses)
            for count in arrays["small"]:
                poses = arrays["tracking"][:count]
                for model in MODELS:
                    size = f"{model}, tracking, {count} x {len(arrays['few bearings'])}"
                    make = functools.partial(self._score, place, model, poses, few=True)
                    self.makers[size + place.label] = make
                    bound = functools.partial(self._bound, place, model, poses)
                    self.makers[f"{size}, bound{place.label}"] = functools.partial(bound, 1)
                    self.makers[f"{size}, bound{place.label}, {IN_A_ROW} calls a wait"] = functools.partial(
                        bound, IN_A_ROW
                    )
        for model in MODELS:
            scans, few = arrays["scans"].shape
            label = f"{model}, {scans} scans of {arrays['scan poses'].shape[1]} x {few}"
            self.makers[label] = functools.partial(self._several, places[0], model)
            for count in FILTERS:
                step = functools.partial(self._follow, places[0], model, count)
                self.makers[f"filter step, {model}, {count} x {few}"] = step
            self.makers[f"preparation, {model}"] = functools.partial(self._prepare, places[0], model)

    def _model(self, place: Host, name: str, few: bool = False) -> Any:
        """Make a model and return it with its scan."""
        prefix = "few " if few else ""
        scanner = gs.Scanner(self._arrays[f"{prefix}bearings"], self._range_max)
        return MODELS[name](self.grid, scanner, backend=place.backend), self._arrays[f"{prefix}scan"]

    def _cast(self, place: Host, poses: np.ndarray) -> Ready:
        caster = gs.RayCaster(self.grid, self._range_max, backend=place.backend)
        bearings = self._arrays["bearings"]
        there, out = place.array(poses), place.array(np.zeros((len(poses), len(bearings)), np.float32))

        def run() -> None:
            caster.cast(there, bearings, out=out)
            place.wait()

        return run, lambda: place.read(out), 1

    def _score(self, place: Host, name: str, poses: np.ndarray, few: bool = False) -> Ready:
        model, ranges = self._model(place, name, few)
        there, out = place.array(poses), place.array(np.zeros(len(poses), np.float32))

        def run() -> None:
            model.log_likelihood(there, ranges, out=out)
            place.wait()

        return run, lambda: place.read(out), 1

    def _bound(self, place: Host, name: str, poses: np.ndarray, count: int) -> Ready:
        model, ranges = self._model(place, name, few=True)
        out = place.array(np.zeros(len(poses), np.float32))
        call = model.bind(place.array(poses), place.array(ranges), out=out)

        def run() -> None:
            for _ in range(count):
                call()
            call.check()

        return run, lambda: place.read(out), count

    def _several(self, place: Host, name: str) -> Ready:
        model, _ = self._model(place, name, few=True)
        poses, scans, found = self._arrays["scan poses"], self._arrays["scans"], []

        def run() -> None:
            found[:] = [model.log_likelihood(poses, scans)]

        return run, lambda: np.asarray(found[0]), 1

    def _follow(self, place: Host, name: str, count: int) -> Ready:
        """Prepare a filter with default options whose robot stands still: predict, correct, estimate."""
        model, ranges = self._model(place, name, few=True)
        poses, found = self._arrays["tracking"], []
        pf = gs.ParticleFilter(model, particles=count, seed=1)
        pf.initialize(mean=poses.mean(axis=0), covariance=np.cov(poses.T))

        def run() -> None:
            pf.predict((0, 0, 0), (0, 0, 0))
            pf.correct(ranges)
            found[:] = [pf.estimate().pose]

        return run, lambda: np.asarray(found[0]), 1

    def _prepare(self, place: Host, name: str) -> Ready:
        found: list[Any] = []

        def run() -> None:
            model, _ = self._model(place, name)
            model.prepare(self._arrays["global"][:1000])
            place.wait()
            found[:] = [model]

        return run, lambda: np.zeros(0), 1


def main() -> None:
    """Answer requests until the input ends."""
    with np.load(sys.argv[1], allow_pickle=False) as file:
        arrays = {name: file[name] for name in file}
    # Libraries print to standard error; standard output is for answers.
    answers, sys.stdout = sys.stdout, sys.stderr

    def answer(value: Any) -> None:
        print(json.dumps(value), file=answers, flush=True)

    rows = Rows(arrays, sys.argv[2])
    answer({"file": gs.__file__, "backend": rows.info.selection, "device": rows.info.name, "rows": list(rows.makers)})
    ready: Ready | None = None
    for line in sys.stdin:
        request = json.loads(line)
        if not request["calls"]:
            # Free the memory of the previous row first.
            ready = None
            ready = rows.makers[request["row"]]()
        assert ready is not None
        run, result, each = ready
        run()
        times = []
        for _ in range(max(request["calls"], 1)):
            begin = time.perf_counter()
            run()
            times.append((time.perf_counter() - begin) / each)
        digest = "" if request["calls"] else hashlib.sha256(np.ascontiguousarray(result()).tobytes()).hexdigest()
        answer({"seconds": min(times), "each": each, "digest": digest})


if __name__ == "__main__":
    main()
