"""The processor for which PoCL compiles, for common processors."""

from __future__ import annotations

import ctypes
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("pyopencl")

from gpusense.backends import get_backend, processor
from gpusense.backends.opencl import pocl

SSE2 = "fpu sse sse2"
CORE2 = f"{SSE2} pni ssse3 cx16"
PENRYN = f"{CORE2} sse4_1"
NEHALEM = f"{PENRYN} sse4_2 popcnt"
SANDY_BRIDGE = f"{NEHALEM} avx aes pclmulqdq"
IVY_BRIDGE = f"{SANDY_BRIDGE} f16c rdrand"
HASWELL = f"{IVY_BRIDGE} avx2 fma abm bmi1 bmi2 movbe"
SKYLAKE_X = f"{HASWELL} adx avx512f avx512bw avx512cd avx512dq avx512vl"
ICE_LAKE = f"{SKYLAKE_X} avx512_vnni avx512_vbmi gfni vaes"
K8 = f"{SSE2} pni cx16 abm sse4a 3dnow"
BULLDOZER = f"{NEHALEM} abm sse4a avx aes xop fma4"
PILEDRIVER = f"{BULLDOZER} f16c fma bmi1 tbm"
EXCAVATOR = f"{PILEDRIVER} avx2 bmi2 movbe rdrand"
ZEN = f"{HASWELL} sse4a adx sha_ni clzero"

# Processor, its name in LLVM 14, its instruction sets, and the processor of the library that fits it.
PROCESSORS = [
    ("Opteron 240", "opteron-sse3", K8, "x86-64"),
    ("Core 2 Duo E8400", "penryn", PENRYN, "penryn"),
    ("Xeon X5650", "westmere", f"{NEHALEM} aes", "penryn"),
    ("Atom N270", "bonnell", f"{SSE2} pni ssse3 movbe", "x86-64"),
    ("Core i5-2500", "sandybridge", SANDY_BRIDGE, "sandybridge"),
    ("Core i5-4670", "haswell", HASWELL, "haswell"),
    ("Pentium G3220, without AVX", "haswell", f"{NEHALEM} abm movbe", "penryn"),
    ("Xeon E5-2680 v4", "broadwell", f"{HASWELL} adx", "haswell"),
    ("Xeon Gold 6148", "skylake-avx512", SKYLAKE_X, "skylake-avx512"),
    ("Xeon Gold 6148, AVX-512 hidden by a hypervisor", "skylake-avx512", f"{HASWELL} adx", "haswell"),
    ("FX-8150", "bdver1", BULLDOZER, "bdver1"),
    ("A12-9800", "bdver4", EXCAVATOR, "haswell"),
    ("EPYC 7742", "znver2", ZEN, "haswell"),
    ("EPYC 9654", "znver3", f"{ICE_LAKE} sse4a avx512_bf16", "skylake-avx512"),
    ("EPYC 9654, AVX-512 hidden by a hypervisor", "znver3", f"{ZEN} gfni", "haswell"),
    ("QEMU's qemu64", "k8", f"{SSE2} pni cx16", "x86-64"),
]


class Described:
    """Imitates PoCL's description of a device: numbers, dangling addresses, and the two names at words 79 and 80."""

    def __init__(self, target: str, name: str, *, version: str = "3.0", platform: str = "Portable Computing Language",
                 width: int = 8) -> None:  # fmt: skip
        self.names = [ctypes.create_string_buffer(text.encode()) for text in (target, name)]
        self.words = np.arange(pocl._WORDS, dtype=np.uint64)
        self.words[::7] = 0xDEAD_BEEF_0000
        self.words[40] = np.uint64(2**64 - 1)
        self.words[79:81] = [ctypes.addressof(name) for name in self.names]
        self.device = SimpleNamespace(
            platform=SimpleNamespace(name=platform), int_ptr=self.words.ctypes.data, driver_version=version,
            native_vector_width_float=width,
        )  # fmt: skip

    def name(self) -> str:
        return ctypes.string_at(int(self.words[80])).decode()


X86 = "x86_64-unknown-linux-gnu"


def width_of(flags: str) -> int:
    """Return the width of the processor's widest vectors by PoCL."""
    return 16 if "avx512f" in flags.split() else 8 if "avx" in flags.split() else 4


@pytest.fixture
def of(monkeypatch):
    """Imitate the instruction sets of another machine, and PoCL's libraries for several processors."""

    def give(flags: str, libraries: bool = True) -> None:
        monkeypatch.setattr(pocl, "instruction_sets", lambda: frozenset(flags.split()))
        monkeypatch.setattr(pocl, "_has_libraries", lambda: libraries)

    return give


@pytest.mark.parametrize(("processor", "llvm", "flags", "fitting"), PROCESSORS, ids=[row[0] for row in PROCESSORS])
def test_the_target_fits_the_library_whatever_llvm_calls_the_processor(of, processor, llvm, flags, fitting):
    of(flags)
    for name in (llvm, "generic", "znver3", "skylake-avx512", fitting):
        made = Described(X86, name, width=width_of(flags))
        before = made.words.copy()
        assert pocl.target_of(made.device) == fitting
        assert made.name() == name
        assert pocl.fit_target(made.device) == (None if name == fitting else fitting)
        assert made.name() == fitting == pocl.target_of(made.device)
        assert np.flatnonzero(made.words != before).tolist() == ([] if name == fitting else [80])
        assert pocl.fit_target(made.device) is None
        assert pocl.lacking_for(made.device) == []


def test_no_name_stands_for_instruction_sets_that_the_processor_lacks():
    for name, _, flags, _ in PROCESSORS:
        sets = frozenset(flags.split())
        library = pocl.chosen_library(sets)
        assert library.needs | library.uses <= sets, name


def test_a_processor_that_no_library_fits_is_reported(of):
    """On a Xeon Phi PoCL takes its library for AVX-512, although the processor lacks most of it."""
    of(f"{HASWELL} avx512f avx512cd avx512er avx512pf")
    made = Described(X86, "knl", width=16)
    assert pocl.lacking_for(made.device) == ["avx512bw", "avx512dq", "avx512vl"]


def test_avx_is_what_llvm_sees_and_not_what_linux_lists(of):
    of(HASWELL)
    assert pocl.target_of(Described(X86, "znver3", width=16).device) == "skylake-avx512"
    of(SKYLAKE_X)
    assert pocl.target_of(Described(X86, "skylake-avx512", width=8).device) == "haswell"
    assert pocl.target_of(Described(X86, "haswell", width=4).device) == "penryn"


@pytest.mark.parametrize(
    "changes",
    [
        {"target": "aarch64-unknown-linux-gnu"},
        {"platform": "Another"},
        {"version": "5.0"},
        {"version": "7.1"},
        {"version": "x"},
    ],
)
def test_only_a_pocl_whose_target_may_not_fit_is_touched(of, changes):
    of(SKYLAKE_X)
    made = Described(**{"target": X86, "name": "znver3"} | changes)
    before = made.words.copy()
    assert pocl.fit_target(made.device) is None
    assert np.array_equal(made.words, before)


def test_a_pocl_whose_library_is_for_one_processor_is_not_touched(of):
    of(SKYLAKE_X, libraries=False)
    made = Described(X86, "znver3", width=16)
    assert pocl.target_of(made.device) == "znver3"
    assert pocl.fit_target(made.device) is None


def test_the_wheels_pocl_compiles_for_the_processor_of_its_library(needs):
    backend = get_backend(needs("opencl"))
    if "Portable" not in backend.info.driver:
        pytest.skip(f"{backend.info.name} is not PoCL's")
    if not pocl._is_misfit(backend._device):
        pytest.skip("this PoCL chooses its target by its library")
    name = pocl.chosen_library(pocl._flags(backend._device)).processor
    assert pocl._find_name(backend._device)[1] == name == backend.info.target
    assert pocl.fit_target(backend._device) is None
    backend.compile("distance_lines", frozenset())


def test_the_fingerprint_distinguishes_processors(monkeypatch, tmp_path):
    texts = [
        "processor\t: 0\nmodel name\t: A\nflags\t\t: avx avx2\n\nprocessor\t: 1\nflags\t: other\n",
        "processor\t: 0\nmodel name\t: A\nflags\t\t: avx2 avx\n",
        "processor\t: 0\nmodel name\t: A\nflags\t\t: avx\n",
        "processor\t: 0\nmodel name\t: B\nflags\t\t: avx avx2\n",
    ]
    marks = []
    for text in texts:
        (tmp_path / "cpuinfo").write_text(text)
        monkeypatch.setattr(processor, "_CPUINFO", str(tmp_path / "cpuinfo"))
        for cached in (processor.instruction_sets, processor.fingerprint, processor._fields):
            cached.cache_clear()
        marks.append(processor.fingerprint())
        assert processor.instruction_sets() >= {"avx"}
    assert marks[0] == marks[1] and len(set(marks)) == 3
    monkeypatch.setattr(processor, "_CPUINFO", str(tmp_path / "absent"))
    for cached in (processor.instruction_sets, processor.fingerprint, processor._fields):
        cached.cache_clear()
    assert processor.instruction_sets() == frozenset()
    assert processor.fingerprint() not in marks
    monkeypatch.undo()
    for cached in (processor.instruction_sets, processor.fingerprint, processor._fields):
        cached.cache_clear()
