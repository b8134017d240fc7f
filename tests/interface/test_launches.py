"""Launches bind arguments by name, and check them against the signature table."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from gpusense.interface.launches import Launch, flags_of, launch
from gpusense.interface.signatures import KERNELS
from gpusense.interface.structs import STRUCTS, dtypes, fields, layout, rounded

KERNEL = "fill_field"
BUFFER = object()
VALUES = dict(
    squared=BUFFER, density=BUFFER, table=BUFFER, rows=3, cols=2, cap=9, beyond=0.5, from_col=0, from_row=0, width=2,
    height=3, begin=14, stride=6,
)  # fmt: skip


def bind(**changes) -> Launch:
    return launch(KERNEL, ("FLOAT64",), (2, 3), **{**VALUES, **changes})


def struct_of(name: str) -> tuple:
    """Return a struct of ones."""
    return STRUCTS[name](*[1] * len(fields(name)))


def test_arguments_are_in_the_order_of_the_row_whatever_their_order():
    names = [argument.name for argument in KERNELS[KERNEL].arguments]
    assert set(names) == set(VALUES)
    bound = bind()
    assert bound.arguments == tuple(VALUES[name] for name in names)
    assert launch(KERNEL, ["FLOAT64"], (2, 3), **dict(reversed(VALUES.items()))) == bound
    assert (bound.kernel, bound.flags, bound.size) == (KERNEL, frozenset({"FLOAT64"}), (2, 3))


@pytest.mark.parametrize("kernel", KERNELS)
def test_every_kernel_takes_the_names_of_its_row(kernel):
    row = KERNELS[kernel]
    values = {
        one.name: BUFFER if one.shape is not None else struct_of(one.type) if one.is_struct else 1
        for one in row.arguments
    }
    assert launch(kernel, row.optional, (1,), **values).named() == values
    plain = launch(kernel, (), (1,), **values)
    assert plain.named() == {one.name: values[one.name] for one in row.arguments if not one.flag}
    assert launch(kernel, (), (1,), **plain.named()) == plain


def test_an_argument_of_a_flag_is_required_with_the_flag_alone():
    values = dict(
        parts=BUFFER, order=BUFFER, log_p=BUFFER, particles=3, count=2, block=1, score=struct_of("Score")
    )  # fmt: skip
    assert launch("sum_parts", ("ORDERED",), (3,), **values).names[:2] == ("parts", "order")
    assert "order" not in launch("sum_parts", (), (3,), **values).names
    with pytest.raises(TypeError, match=r"^sum_parts: .* missing counts, constant_terms, batch$"):
        launch("sum_parts", ("SCANS",), (3,), **values)


def test_missing_and_unknown_arguments_are_named():
    fewer = {name: value for name, value in VALUES.items() if name not in ("cap", "stride")}
    rule = f"^{KERNEL}: arguments must be those of its signature, got "
    with pytest.raises(TypeError, match=rule + "missing cap, stride$"):
        launch(KERNEL, (), (2, 3), **fewer)
    with pytest.raises(TypeError, match=rule + "unknown colour$"):
        bind(colour=1)
    with pytest.raises(TypeError, match=rule + "missing cap, stride and unknown cape, width_$"):
        launch(KERNEL, (), (2, 3), **fewer, cape=1, width_=2)


@pytest.mark.parametrize(
    ("name", "value", "rule"),
    [
        ("table", 3, "a buffer, got a int"),
        ("table", np.float32(3), "a buffer, got a float32"),
        ("cap", 3.0, "an integer, got a float"),
        ("cap", np.float64(3), "an integer, got a float64"),
        ("cap", BUFFER, "an integer, got a object"),
        ("beyond", BUFFER, "a number, got a object"),
        ("beyond", np.zeros(1), "a number, got a ndarray"),
        ("beyond", "1", "a number, got a str"),
    ],
)
def test_a_mistyped_argument_is_named(name, value, rule):
    for _ in range(2):
        with pytest.raises(TypeError, match=rf"^{KERNEL}: {name} must be {rule}$"):
            bind(**{name: value})
    bind()


@pytest.mark.parametrize(("name", "value"), [("cap", np.int64(3)), ("beyond", 3), ("beyond", np.float32(3))])
def test_numbers_of_numpy_and_integers_for_real_numbers_are_taken(name, value):
    assert bind(**{name: value}).named()[name] is value


def test_flags_of_a_program_are_those_of_all_launches():
    first, second = bind(), launch(KERNEL, ("LINEAR", "LOG_TABLE"), (1, 1), **VALUES)
    assert flags_of((first, second)) == {"FLOAT64", "LINEAR", "LOG_TABLE"}
    assert flags_of(()) == frozenset()


def test_a_struct_is_no_number_and_no_other_struct():
    row = KERNELS["place_poses"].arguments
    values = {one.name: BUFFER if one.shape is not None else struct_of(one.type) if one.is_struct else 1 for one in row}
    for wrong in (1, (1, 2, 3, 4), struct_of("Caster"), BUFFER):
        with pytest.raises(TypeError, match=r"^place_poses: window must be a Window, got a "):
            launch("place_poses", (), (1,), **{**values, "window": wrong})
    with pytest.raises(TypeError, match=r"^place_poses: poses must be a buffer, got a Window"):
        launch("place_poses", (), (1,), **{**values, "poses": struct_of("Window")})


@pytest.mark.parametrize("name", STRUCTS)
def test_structs_have_the_memory_of_c(name):
    """NumPy's aligned record types have the layout of C compilers."""
    for real in (np.dtype(np.float32), np.dtype(np.float64)):
        kinds = dtypes(name, real)
        aligned = np.dtype([(field, kind) for field, kind in zip(fields(name), kinds, strict=True)], align=True)
        values = tuple(range(3, 3 + len(kinds)))
        packed = struct.pack(layout(name, real), *values)
        assert len(packed) == aligned.itemsize
        assert np.frombuffer(packed, aligned)[0].tolist() == values
        assert rounded(values, name, real) == values
