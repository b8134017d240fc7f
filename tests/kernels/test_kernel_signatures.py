"""The bodies of every kernel have one signature in all languages."""

from __future__ import annotations

import functools
import importlib
import inspect
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from support.kernel_scenes import PRECISIONS

from gpusense.interface import sources
from gpusense.interface.kernel_files import kernel_root, opencl_names, opencl_source, warp_files
from gpusense.interface.signatures import KERNELS
from gpusense.interface.sources import assemble, parameters, source_text

each_kernel = pytest.mark.parametrize("kernel", list(KERNELS))


@functools.cache
def opencl_bodies() -> dict[str, list[str]]:
    """Return the bodies of every kernel in the OpenCL files, by name; some have a second body for vectors."""
    found: dict[str, list[str]] = {}
    for file in opencl_names():
        text = opencl_source(file)
        for match in re.finditer(r"kernel void (\w+)\((.*?)\) \{(.*?)^\}", text, re.DOTALL | re.MULTILINE):
            assert match.group(2) == "ARGUMENTS", f"{file}.cl: {match.group(1)} writes its parameters itself"
            found.setdefault(match.group(1), []).append(match.group(3))
    return found


def test_every_opencl_kernel_has_a_row_and_every_row_a_kernel() -> None:
    assert sorted(opencl_bodies()) == sorted(KERNELS)


def test_a_program_holds_no_kernel_of_another_file() -> None:
    for file in {row.file for row in KERNELS.values()}:
        text = assemble(file, frozenset())
        assert all(KERNELS[kernel].file == file for kernel in re.findall(r"^kernel void (\w+)", text, re.MULTILINE))
    assert "kernel void cast_ranges(" in assemble("ranges", frozenset())


@each_kernel
def test_opencl_kernels_have_the_axes_of_their_row(kernel: str) -> None:
    for body in opencl_bodies()[kernel]:
        axes = {int(axis) for axis in re.findall(r"get_global_id\((\d)\)", body)}
        assert axes == set(range(len(KERNELS[kernel].launch)))


def test_opencl_parameters_are_written_from_the_row() -> None:
    assert parameters("sum_parts", frozenset({"ORDERED", "SCANS"})) == (
        "global const real *parts, global const int *order, global const int *counts, global const real "
        "*constant_terms, global real *log_p, const int particles, const int count, const int block, "
        "const Score score, const ScanBatch batch"
    )
    assert parameters("sum_parts", frozenset()) == (
        "global const real *parts, global real *log_p, const int particles, const int count, const int block, "
        "const Score score"
    )
    assert "; global const int *order = 0; " in source_text("sums", frozenset()).replace("{ ", "; ")
    assert "global const real2 *restrict ray, global real *restrict ranges, const Window window, const int " in (
        parameters("cast_tiles", frozenset())
    )
    flags = frozenset({"SHAPES", "WORLDS"})
    assert f"kernel void cast_ranges({parameters('cast_ranges', flags)}) {{" in source_text("ranges", flags)


def test_a_kernel_without_a_row_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sources, "opencl_source", lambda file: "kernel void fourth(ARGUMENTS) {\n}\n")
    with pytest.raises(ValueError, match=r"^ranges.cl: a kernel must have a row in the signature table, got 'fourth'"):
        source_text("ranges", frozenset())


@each_kernel
def test_reference_kernels_have_the_arguments_of_their_row(kernel: str) -> None:
    row = KERNELS[kernel]
    body = getattr(importlib.import_module(f"gpusense.reference.{row.file}"), kernel)
    assert list(inspect.signature(body).parameters) == ["flags", *(argument.name for argument in row.arguments)]


def warp_types(precision: type) -> Any:
    """Return the types of Warp's kernels in a precision."""
    return warp_files().precision(frozenset({"FLOAT64"} if precision is np.float64 else ()))


@pytest.mark.parametrize("precision", PRECISIONS)
@each_kernel
def test_warp_kernels_have_the_arguments_of_their_row(
    kernel: str, precision: type, needs: Callable[[str], str]
) -> None:
    needs("warp")
    import warp as wp

    real = {np.float32: (wp.float32, wp.vec2f, wp.vec4f), np.float64: (wp.float64, wp.vec2d, wp.vec4d)}[precision]
    types = dict(zip(("real", "real2", "real4"), real, strict=True))
    types |= {"int": wp.int32, "int2": wp.vec2i, "uchar": wp.uint8, "ushort": wp.uint16, "entry": wp.uint16}
    types |= {"double": wp.float64, "coordinate": wp.float64, "measured": wp.float64}
    types |= vars(warp_types(precision))
    row = KERNELS[kernel]
    made = warp_files().kernel_of(kernel, frozenset({"FLOAT64"} if precision is np.float64 else ()))
    expected = {a.name: (types[a.type], a.shape is not None) for a in row.arguments}
    found = {
        name: (getattr(annotation, "dtype", annotation), isinstance(annotation, wp.array))
        for name, annotation in inspect.get_annotations(made.func).items()
    }
    assert list(found.items()) == list(expected.items())
    # The last thread index runs fastest in Warp, the first axis of the row everywhere else.
    (indices,) = re.findall(r"^ *(.*) = (?:work_item\()?wp\.tid\(\)\)?$", inspect.getsource(made.func), re.MULTILINE)
    assert len(indices.split(",")) == len(row.launch)


def test_a_warp_kernel_has_the_names_of_its_row(needs: Callable[[str], str]) -> None:
    needs("warp")

    def wrap_headings(poses, count):
        pass

    with pytest.raises(TypeError, match=r"^wrap_headings: parameters must be those of its row, got poses, count$"):
        warp_files().typed(wrap_headings, frozenset())


def test_both_languages_have_the_same_files() -> None:
    names = {path.stem for path in (kernel_root() / "opencl").glob("*.cl")}
    assert {path.stem for path in (kernel_root() / "warp").glob("*.py")} == names | {"__init__", "prelude"}
