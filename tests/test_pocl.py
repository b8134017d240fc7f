"""PoCL on a processor that its compiler does not know."""

import ctypes
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("pyopencl")
from gpusense.backends import _pocl, get_backend

ZEN_5 = {"avx", "avx2", "fma", "bmi2", "avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl", "avx_vnni"}


@pytest.mark.parametrize(
    ("flags", "name"),
    [
        (ZEN_5, "skylake-avx512"),
        (ZEN_5 - {"avx512vl"}, "haswell"),
        (ZEN_5 - {"avx512vl", "fma"}, "sandybridge"),
        ({"sse2"}, "x86-64"),
        (set(), "x86-64"),
    ],
)
def test_a_processor_has_no_instructions_that_the_machine_lacks(flags, name):
    assert _pocl.known_processor(flags) == name


def described(target: bytes, processor: bytes, platform: str = "Portable Computing Language"):
    """A device whose description holds numbers, addresses of nothing, and the two names at words 79 and 80."""
    names = [ctypes.create_string_buffer(target), ctypes.create_string_buffer(processor)]
    words = np.arange(_pocl._WORDS, dtype=np.uint64)
    words[::7] = 0xDEAD_BEEF_0000
    words[40] = np.uint64(2**64 - 1)
    words[79:81] = [ctypes.addressof(name) for name in names]
    device = SimpleNamespace(platform=SimpleNamespace(name=platform), int_ptr=words.ctypes.data)
    return device, words, names


def test_the_unknown_processor_is_renamed_and_nothing_else_changes():
    device, words, _names = described(b"x86_64-unknown-linux-gnu", b"generic")
    before = words.copy()
    name = _pocl.mend(device)
    assert name in {name for _, name in _pocl._PROCESSORS}
    assert ctypes.string_at(int(words[80])) == name.encode()
    assert np.flatnonzero(words != before).tolist() == [80]
    assert _pocl.mend(device) is None


@pytest.mark.parametrize(
    ("target", "processor", "platform"),
    [
        (b"x86_64-unknown-linux-gnu", b"znver3", "Portable Computing Language"),
        (b"aarch64-unknown-linux-gnu", b"generic", "Portable Computing Language"),
        (b"x86_64-unknown-linux-gnu", b"generic", "Another Platform"),
    ],
)
def test_what_needs_no_mending_is_not_touched(target, processor, platform):
    device, words, _names = described(target, processor, platform)
    before = words.copy()
    assert _pocl.mend(device) is None
    assert np.array_equal(words, before)


def test_pocl_compiles_on_this_processor(needs):
    backend = get_backend(needs("opencl"))
    if "Portable" not in backend.info.driver:
        pytest.skip(f"{backend.info.name} is not PoCL's")
    assert _pocl.mend(backend._device) is None
    backend.compile("distance_lines", frozenset())
