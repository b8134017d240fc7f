"""Fixtures that every test may use."""

from __future__ import annotations

import dataclasses
import gc
import os
from collections import Counter, defaultdict
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

import pytest

# Workers fill the processor: threads of linear algebra would wait for each other. NumPy reads this when it is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from gpusense.backends import Backend, arrays, get_backend
from gpusense.backends.base import Adopted

# Failed assertions of helpers show their values, as in tests.
pytest.register_assert_rewrite("support")
from support.array_libraries import Array, counted_copies, installed  # noqa: E402
from support.map_files import yaml_text  # noqa: E402
from support.selection import BACKENDS, NO_FLOAT64, lacks_float64, present, skip_or_fail  # noqa: E402

# JAX would reserve three quarters of a GPU's memory in each process that imports it.
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")


# Folders and files of the five-minute subset, ``-m quick``; see CONTRIBUTING.md.
QUICK = (
    "commands/test_cli.py", "commands/test_first_hour.py", "commands/test_output_streams.py",
    "evaluation/test_score.py", "interface", "kernels/test_kernel_casts.py", "kernels/test_kernel_flags.py",
    "kernels/test_kernel_signatures.py", "kernels/test_three_bodies.py", "localization", "logs",
    "models/scan/test_raycast_worlds.py", "models/scan/test_densities.py", "models/scan/test_sonar.py",
    "models/test_bad_input_models.py", "project/test_docstrings.py", "project/test_layout.py",
    "project/test_project_files.py", "project/test_site.py", "project/test_types.py", "project/test_words.py",
    "tables", "world",
)  # fmt: skip


GOLDEN = (5**0.5 - 1) / 2
# Parts of a test's sample that run by default and in .ci/run.
BRIEF, CHECKED = 0.1, 0.3

# Objects of collection live as long as the tests; searching them for garbage would take a quarter of its time.
gc.disable()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Return a worker for each usable core; none for tests of a single file, which stay in this process."""
    files = {Path(argument.split("::")[0]) for argument in config.args}
    if len(files) == 1 and files.pop().is_file():
        return 0
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def pytest_collection_finish() -> None:
    """Collect garbage of later objects again."""
    gc.collect()
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of the subset, and as slow or long the settings beyond the samples of a test."""
    number: Counter[str] = Counter()
    kept: set[tuple[str, str]] = set()
    brief: set[tuple[str, str]] = set()
    beyond_brief: dict[tuple[str, str], list[pytest.Item]] = defaultdict(list)
    left: dict[tuple[str, str], list[pytest.Item]] = defaultdict(list)
    for item in items:
        sampled, long_on = item.get_closest_marker("sampled"), item.get_closest_marker("long_on")
        params = item.callspec.params if hasattr(item, "callspec") else {}
        selection = str(params.get("backend", params.get("device", "")))
        if long_on is not None and selection.startswith(long_on.args):
            item.add_marker("long")
        if sampled is not None:
            function = item.nodeid.split("[")[0]
            where = function, selection
            if where[1] == sampled.kwargs.get("without"):
                item.add_marker("slow")
                continue
            # Multiples of the golden ratio spread evenly over every parameter, for any order of its values.
            place = number[function] * GOLDEN % 1
            if place < CHECKED * sampled.args[0]:
                kept.add(where)
                if place < BRIEF * sampled.args[0]:
                    brief.add(where)
                else:
                    beyond_brief[where].append(item)
            else:
                left[where].append(item)
            number[function] += 1
    for where, beyond in left.items():
        # A sample omits only backends that its marker names.
        for item in beyond if where in kept else beyond[1:]:
            item.add_marker("slow")
    for where, beyond in beyond_brief.items():
        for item in beyond if where in brief else beyond[1:]:
            item.add_marker("long")
    for item in items:
        path = item.path.relative_to(Path(__file__).parent).as_posix()
        slow = any(item.get_closest_marker(name) is not None for name in ("slow", "long"))
        if not slow and any(path == part or path.startswith(f"{part}/") for part in QUICK):
            item.add_marker("quick")


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> Generator[None, object, object]:
    """Skip a test that computes in float64 where a tested device has none."""
    try:
        return (yield)
    except ValueError as error:
        if NO_FLOAT64.search(str(error)) and lacks_float64():
            pytest.skip(str(error))
        raise


@pytest.fixture
def needs() -> Callable[[str], str]:
    """Return a function: ``needs("opencl")`` is the selection string to test; it skips where the backend is absent."""
    return present


@pytest.fixture(params=BACKENDS)
def backend(request: pytest.FixtureRequest) -> str:
    """Return the selection string of each tested backend in turn."""
    return present(request.param)


@pytest.fixture(params=["opencl", "warp"])
def device(request: pytest.FixtureRequest, needs: Callable[[str], str]) -> Backend:
    """Return the backend of each kernel language in turn."""
    return get_backend(needs(request.param))


@pytest.fixture
def as_gpu(backend: str) -> Iterator[Callable[..., Backend]]:
    """Return a function that makes each tested backend pass as a GPU (True) or a processor (False). ``scalar`` makes
    the processor's kernels compute one particle or beam at a time, like a GPU's kernels.
    """
    device = get_backend(backend)
    before = device.info

    def pretend(gpu: bool = True, *, scalar: bool = False) -> Backend:
        lanes = 1 if gpu or scalar else before.lanes
        kind, loops = "gpu" if gpu else "cpu", before.vector_loops and not (gpu or scalar)
        device.info = dataclasses.replace(before, kind=kind, lanes=lanes, vector_loops=loops)
        return device

    yield pretend
    device.info = before


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Return the folder of recorded data that GPUSENSE_DATA names; skip the test without it."""
    folder = os.environ.get("GPUSENSE_DATA", "")
    if folder and Path(folder).is_dir():
        return Path(folder)
    reason = f"GPUSENSE_DATA must name the folder of recorded data, got {folder!r}"
    if folder:
        pytest.fail(reason)
    skip_or_fail("data", reason)
    raise AssertionError(reason)


@pytest.fixture
def no_data(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide recorded data from the environment."""
    monkeypatch.delenv("GPUSENSE_DATA", raising=False)


@pytest.fixture
def place(tmp_path):
    """Return a function that writes an image (bytes, or an object with ``save``) and its YAML, and returns its
    path."""

    def write(content, image="map.pgm", save=None, **changes):
        if isinstance(content, bytes):
            (tmp_path / image).write_bytes(content)
        else:
            content.save(tmp_path / image, **(save or {}))
        (tmp_path / "map.yaml").write_text(yaml_text(image, **changes))
        return tmp_path / "map.yaml"

    return write


@pytest.fixture
def warp_as_gpu(needs: Callable[[str], str], monkeypatch: pytest.MonkeyPatch) -> Backend:
    """Return Warp's processor as a GPU with arrays of Warp and ``fakelib`` in its memory."""
    needs("warp")
    import warp as wp

    installed(monkeypatch)
    monkeypatch.setattr(arrays, "on_device", lambda array: isinstance(array, (wp.array, Array, Adopted)))
    found = get_backend("warp:cpu")
    monkeypatch.setattr(found, "info", dataclasses.replace(found.info, kind="gpu", lanes=1, vector_loops=False))
    return found


@pytest.fixture
def warp_copies(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """Record the bytes that models copy to Warp's device and back."""
    import warp  # noqa: F401

    from gpusense.backends.warp.backend import WarpBackend

    return counted_copies(monkeypatch, WarpBackend)
