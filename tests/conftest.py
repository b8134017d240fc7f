"""Fixtures that every test may use."""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import pytest
from map_files import yaml_text

from gpusense.backends import Backend, get_backend

# JAX would take three quarters of a GPU's memory for each process that imports it.
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")

# Where tests run; on a machine with a GPU for instance GPUSENSE_TEST_BACKENDS=numpy,opencl,warp:cuda:0.
BACKENDS = os.environ.get("GPUSENSE_TEST_BACKENDS", "numpy,opencl,warp:cpu").split(",")


def required(feature: str) -> bool:
    """Whether GPUSENSE_REQUIRE, a comma-separated list, says that a feature must not be skipped."""
    return feature in [word.strip() for word in os.environ.get("GPUSENSE_REQUIRE", "").split(",")]


def skip_or_fail(feature: str, reason: str) -> None:
    """Skip the test, or fail it where the feature is required."""
    if required(feature):
        pytest.fail(reason)
    pytest.skip(reason)


def present(selection: str) -> str:
    """The tested selection string of a backend's name or selection; the test is skipped where it is absent."""
    chosen = next((name for name in BACKENDS if name.split(":")[0] == selection), selection)
    try:
        get_backend(chosen)
    except ValueError as error:
        skip_or_fail(chosen.split(":")[0], str(error))
    return chosen


@pytest.fixture
def needs() -> Callable[[str], str]:
    """``needs("opencl")`` returns the selection string to test, or skips."""
    return present


@pytest.fixture(params=BACKENDS)
def backend(request: pytest.FixtureRequest) -> str:
    """The selection string of each tested backend in turn."""
    return present(request.param)


def on_every_backend(*, on_warp: Callable[..., bool], **cases: Iterable[object]) -> pytest.MarkDecorator:
    """Parametrizes a test over backends and cases, on Warp only over some: it compiles each set of flags anew."""
    chosen = [
        (selection, *case)
        for selection, case in itertools.product(BACKENDS, itertools.product(*cases.values()))
        if not selection.startswith("warp") or on_warp(**dict(zip(cases, case, strict=True)))
    ]
    return pytest.mark.parametrize(("backend", *cases), chosen, indirect=["backend"])


@pytest.fixture(params=["opencl", "warp"])
def device(request: pytest.FixtureRequest, needs: Callable[[str], str]) -> Backend:
    """The backend of each kernel language in turn."""
    return get_backend(needs(request.param))


@pytest.fixture
def as_gpu(backend: str) -> Iterator[Callable[[bool], Backend]]:
    """Each tested backend in turn; called with True it pretends to be a GPU, with False to be a processor."""
    device = get_backend(backend)
    before = device.info

    def pretend(gpu: bool = True) -> Backend:
        device.info = (
            dataclasses.replace(before, kind="gpu", lanes=1) if gpu else dataclasses.replace(before, kind="cpu")
        )
        return device

    yield pretend
    device.info = before


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of recorded data that GPUSENSE_DATA names; the test is skipped without it."""
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
    """Without recorded data, whatever the environment names."""
    monkeypatch.delenv("GPUSENSE_DATA", raising=False)


@pytest.fixture
def place(tmp_path):
    """Write an image (bytes, or something to save) and its YAML; give the YAML's path."""

    def write(content, image="map.pgm", save=None, **changes):
        if isinstance(content, bytes):
            (tmp_path / image).write_bytes(content)
        else:
            content.save(tmp_path / image, **(save or {}))
        (tmp_path / "map.yaml").write_text(yaml_text(image, **changes))
        return tmp_path / "map.yaml"

    return write
