"""The table of backends: a new backend is an entry and a module with its library."""

from __future__ import annotations

import dataclasses
import re
import sys
from types import ModuleType

import pytest
from support.paths import ROOT

import gpusense as gs
from gpusense.backends import BackendInfo, get_backend, listing, registry, selection
from gpusense.backends.numpy.backend import NumpyBackend
from gpusense.backends.proof import DeviceCheck
from gpusense.backends.registry import BY_NAME, ENTRIES, SPEED_CLASSES, Absent, Entry, Library

INFO = BackendInfo("metal:0", "metal", "Some GPU", "gpu", "Metal 3", 1 << 30, 1 << 28, False)
METAL = Entry(
    name="metal", package="metalpy", module="metal_library", install="pip install metalpy", selections=("metal:<n>",),
    speed={"gpu": -1}, by_name=True, queue="a command queue of Metal", array_module="metalpy",
    array_selection="<the array's queue>",
)  # fmt: skip


class CommandQueue:
    """A user's queue."""


class Metal(Library):
    """One GPU, on NumPy."""

    def list_devices(self):
        return [(INFO, "handle")]

    def open(self, info, handle):
        assert handle == "handle"
        return NumpyBackend(info)

    def absent(self):
        return [Absent("Metal's debugger (absent)", "gpu", "it is not here; install it")]

    def queue_key(self, candidate):
        return id(candidate) if isinstance(candidate, CommandQueue) else None

    def device_of_queue(self, queue):
        return INFO, "handle"

    def open_queue(self, queue, info):
        return NumpyBackend(info)


@pytest.fixture
def metal(monkeypatch):
    """Add a backend to the table; return its library."""
    library, package = ModuleType("metal_library"), ModuleType("metalpy")
    library.LIBRARY, package.Array = Metal(), type("Array", (), {})
    package.__spec__ = sys.__spec__
    entries = (*ENTRIES, METAL)
    for module in (registry, listing, selection):
        monkeypatch.setattr(module, "ENTRIES", entries)
        monkeypatch.setattr(module, "BY_NAME", {entry.name: entry for entry in entries})
    monkeypatch.setattr(listing, "SPEED_CLASSES", (("metal", "gpu"), *SPEED_CLASSES))
    monkeypatch.setitem(sys.modules, "metal_library", library)
    monkeypatch.setitem(sys.modules, "metalpy", package)
    monkeypatch.setattr(listing.proof, "verdict_on", lambda info, **options: DeviceCheck(True, 4, info.float64))
    selection.forget()
    yield library.LIBRARY
    selection.forget()


def test_every_entry_has_its_folder_and_its_words():
    assert [entry.name for entry in ENTRIES] == list(BY_NAME) and {"numpy", "opencl", "warp"} <= set(BY_NAME)
    for entry in ENTRIES:
        assert entry.module.startswith(f"gpusense.backends.{entry.name}.")
        assert entry.install.startswith("pip install ") and all(entry.name in one for one in entry.selections)
        library, reason = registry.load(entry)
        assert (library is None) == bool(reason) and (library is None or isinstance(library, Library))


def test_speed_classes_are_the_ranks_of_entries():
    ranks = {rank: (entry.name, kind) for entry in ENTRIES for kind, rank in entry.speed.items()}
    assert tuple(ranks[rank] for rank in range(len(SPEED_CLASSES))) == SPEED_CLASSES
    order = [SPEED_CLASSES.index(row) for row in (("opencl", "gpu"), ("opencl", "cpu"), ("warp", "cpu"))]
    assert order == sorted(order)


def test_a_new_backend_is_listed_and_selected(metal):
    mine = [device for device in gs.devices() if device.backend == "metal"]
    assert [(device.selection, device.available, device.lanes) for device in mine] == [
        ("metal:0", True, 4),
        ("", False, 1),
    ]
    assert mine[1].reason == "it is not here; install it"
    for name in ("auto", "metal", "metal:0", "metal:some"):
        assert get_backend(name) is get_backend("metal:0")
    assert get_backend("metal").info == dataclasses.replace(INFO, lanes=4)
    with pytest.raises(ValueError, match=r"must be a device that is present \(metal:0 \(Some GPU\)\), got 'metal:7'"):
        get_backend("metal:7")
    with pytest.raises(ValueError, match=r"backend: must be 'auto', .*'warp:cuda:<n>'.* or 'metal:<n>', got 'metl'"):
        get_backend("metl")


def test_devices_anew_renews_all_verdicts(metal, monkeypatch):
    """Verdicts on a library, such as on loading drivers, are renewed before its devices are listed and proved."""
    seen = []
    monkeypatch.setattr(metal, "renew", lambda: seen.append("library"))
    monkeypatch.setattr(metal, "list_devices", lambda: seen.append("list") or [(INFO, "handle")])
    verdict_on = lambda info, *, anew=False, **options: seen.append(anew) or DeviceCheck(True, 4, True)  # noqa: E731
    monkeypatch.setattr(listing.proof, "verdict_on", verdict_on)
    for entry in ENTRIES[1:]:
        library, _ = registry.load(entry)
        if library is not None:
            monkeypatch.setattr(library, "renew", lambda: None)
    gs.devices()
    assert "library" not in seen and True not in seen
    seen.clear()
    gs.devices(anew=True)
    assert seen.index("library") < seen.index("list") and False not in seen


def test_a_simulator_that_is_its_backend_alone_is_selected_by_name(metal, monkeypatch):
    info = dataclasses.replace(INFO, selection="metal")
    monkeypatch.setattr(metal, "list_devices", lambda: [(info, "handle")])
    monkeypatch.setattr(metal, "is_simulator", lambda one: True)
    assert get_backend("metal").info == info
    assert get_backend("auto").info != info


def test_a_queue_of_a_new_backend_selects_it(metal):
    queue = CommandQueue()
    assert get_backend(queue).info.backend == "metal"
    message = "must be a selection string or a queue of pyopencl or a command queue of Metal, got 3"
    with pytest.raises(TypeError, match=message):
        get_backend(3)


def test_arrays_of_a_new_backend(metal):
    array = sys.modules["metalpy"].Array()
    assert registry.entry_of_array(array) is METAL and registry.entry_of_array(3) is None
    model = gs.LikelihoodFieldModel(gs.OccupancyGrid([[0, 100]], 1.0), gs.Scanner([0.0], 5.0), backend="numpy")
    with pytest.raises(TypeError, match="poses: must be in host memory for numpy, or the model made with backend=<the"):
        model.log_likelihood(array, [1.0])


def test_a_child_is_set_up_by_its_library(metal, monkeypatch):
    seen = []
    monkeypatch.setattr(metal, "set_up_child", seen.append, raising=False)
    registry.set_up_child("metal", {"drivers": 1})
    assert seen == [{"drivers": 1}]
    monkeypatch.setattr(registry, "load", lambda entry: (None, "metalpy is not installed"))
    with pytest.raises(RuntimeError, match="metalpy is not installed"):
        registry.set_up_child("metal", None)


def test_a_wrapper_that_is_no_backend_is_refused():
    """Equal names of methods do not make a backend."""

    class Wrapper:
        def __init__(self, backend):
            self._backend = backend

        def __getattr__(self, name):
            return getattr(self._backend, name)

    with pytest.raises(TypeError, match="backend: must be a selection string or a queue of pyopencl, got"):
        get_backend(Wrapper(get_backend("numpy")))


def test_kinds_select_their_fastest_device():
    cpu = gs.backends.get_backend("cpu")
    assert (cpu.info.kind == "cpu" and cpu.info.backend != "numpy") or len(gs.devices()) == 1
    gpus = [device for device in gs.devices() if device.kind == "gpu" and device.available]
    for word in ("gpu", "cuda", "cuda:9"):
        if gpus and word != "cuda:9":
            assert gs.backends.get_backend(word).info.kind == "gpu"
        else:
            with pytest.raises(ValueError, match=f"backend: .*, got '(warp:)?{word}'"):
                gs.backends.get_backend(word)


def test_a_misspelt_name_suggests_the_right_one():
    with pytest.raises(AttributeError, match="no attribute 'BeamModle'; did you mean 'BeamModel'"):
        gs.BeamModle  # noqa: B018


def test_the_page_of_drivers_names_every_backend():
    page = (ROOT / "docs" / "drivers.md").read_text(encoding="utf-8")
    assert [entry.name for entry in ENTRIES if not re.search(rf"\b{entry.name}:|^{entry.name} ", page, re.M)] == []
