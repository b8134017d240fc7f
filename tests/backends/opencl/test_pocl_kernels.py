"""Programs of PoCL that are made of bitcode."""

from __future__ import annotations

import pytest


@pytest.fixture
def kernels(needs, tmp_path, monkeypatch):
    needs("opencl")
    from gpusense.backends import cache
    from gpusense.backends.opencl import pocl

    stored: dict[str, bytes] = {}
    monkeypatch.setattr(cache, "load_entry", stored.get)
    monkeypatch.setattr(cache, "store_entry", stored.__setitem__)
    monkeypatch.setattr(pocl.atexit, "register", lambda _: None)

    def new(folder):
        (tmp_path / folder).mkdir()
        return pocl.PoclKernels(tmp_path / folder)

    return new


def test_only_the_first_process_compiles_a_program(kernels):
    first = kernels("first")

    def compiled():
        for name, kernel in (("AB", b"cast_2"), ("CD", b"score_1"), ("EF", b"cast_3")):
            folder = first.folder / name / "folder"
            folder.mkdir(parents=True)
            (folder / "program.bc").write_bytes(b"BC " + kernel)
        return "of source"

    assert first.built("key", ["score_1"], compiled, lambda bitcode: bitcode) == b"BC score_1"
    # PoCL has compiled the kernel for groups of 8.
    (first.folder / "score_1" / "8-1-1").mkdir(parents=True)
    (first.folder / "score_1" / "8-1-1" / "score_1.so").write_bytes(b"code")
    first.save()
    second = kernels("second")
    assert second.built("key", ["score_1"], pytest.fail, lambda bitcode: bitcode) == b"BC score_1"
    assert (second.folder / "score_1" / "8-1-1" / "score_1.so").read_bytes() == b"code"


def test_where_pocl_writes_elsewhere_the_compiled_program_is_used(kernels):
    assert kernels("first").built("key", ["score_1"], lambda: "of source", pytest.fail) == "of source"


def test_kernels_of_different_programs_have_different_names(needs):
    needs("opencl")
    from gpusense.backends.opencl.pocl import own_name

    names = {own_name(kernel, key) for kernel in ("score", "cast") for key in ("source 1", "source 2")}
    assert len(names) == 4
    assert all(name.isidentifier() for name in names)
