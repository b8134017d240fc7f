"""The processor for which PoCL compiles; PoCL is the OpenCL driver for processors that comes as a wheel.

PoCL has its library of OpenCL functions compiled for several processors, and takes the best one whose instruction sets
the machine has. Before version 5 it compiles kernels for the processor that LLVM names instead, and the two need not
fit: LLVM 14 identifies a Zen 4 as ``znver3``, without the AVX-512 that the library uses, and a Zen 5 as ``generic``,
which names no processor (pocl issue 1049). Vectors are then passed in other registers than the callee expects, and the
compiler aborts the process. Version 5 compiles kernels for the processor of its library, which always fits. This module
does the same for older versions.

These have no setting for it: the environment variable POCL_LLVM_CPU_NAME also came with version 5, build options are
checked against a list, and the name of the device's processor overrides them. Therefore that name is replaced in PoCL's
memory.
"""

from __future__ import annotations

import ctypes
import functools
import os
import re
import struct
from collections.abc import Set
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from gpusense.backends.processor import instruction_sets

if TYPE_CHECKING:
    import pyopencl as cl
# The platform's name.
NAME = "Portable Computing Language"


class Library(NamedTuple):
    """A library of OpenCL functions in PoCL."""

    name: str  # the end of its file's name
    needs: frozenset[str]  # instruction sets, by Linux's names, with which PoCL chooses it
    processor: str  # the processor for which it was compiled, by LLVM's name
    uses: frozenset[str] = frozenset()  # further instruction sets that code for that processor has


def _sets(words: str) -> frozenset[str]:
    return frozenset(words.split())


# PoCL takes the last one whose needs a processor meets (getX86KernelLibName in PoCL 3).
LIBRARIES = (
    Library("sse2", _sets(""), "x86-64"),
    Library("ssse3", _sets("ssse3 cx16"), "core2"),
    Library("sse41", _sets("sse4_1 cx16"), "penryn", _sets("ssse3")),
    Library("avx", _sets("avx cx16 popcnt"), "sandybridge", _sets("ssse3 sse4_1 sse4_2")),
    Library("avx_f16c", _sets("avx cx16 popcnt f16c"), "ivybridge", _sets("ssse3 sse4_1 sse4_2")),
    Library("avx_fma4", _sets("avx cx16 popcnt xop fma4"), "bdver1", _sets("ssse3 sse4_1 sse4_2 sse4a")),
    Library("avx2", _sets("avx avx2 cx16 popcnt abm f16c fma bmi1 bmi2"), "haswell", _sets("ssse3 sse4_1 sse4_2")),
    Library(
        "avx512",
        _sets("avx512f"),
        "skylake-avx512",
        _sets("avx2 fma f16c abm bmi1 bmi2 avx512bw avx512cd avx512dq avx512vl"),
    ),
)
# Words of a device's description that are searched for names, and the longest name.
_WORDS = 256
_NAME = 24
# The version whose programs were made of bitcode; others were not tried.
_OF_BITCODE = (3, 0)
# The first version that compiles for the processor of its library.
_FITTING = (5, 0)


def is_pocl(device: cl.Device) -> bool:
    """Return whether PoCL is a device's driver."""
    return NAME in device.platform.name


def chosen_library(flags: Set[str]) -> Library:
    """Return the library that PoCL takes on a processor with these instruction sets."""
    return next(library for library in reversed(LIBRARIES) if library.needs <= flags)


def lacking_for(device: cl.Device) -> list[str]:
    """Return the instruction sets that PoCL's library uses on a device and that the processor lacks."""
    if not _is_misfit(device) or not instruction_sets():
        return []
    flags = _flags(device)
    return sorted(chosen_library(flags).uses - flags)


def target_of(device: cl.Device) -> str:
    """Return the processor for which PoCL compiles once :func:`fit_target` was called; empty where it is not known."""
    if not is_pocl(device):
        return ""
    _, name = _find_name(device)
    return chosen_library(_flags(device)).processor if name and _is_misfit(device) else name


def fit_target(device: cl.Device) -> str | None:
    """Make PoCL compile kernels for the processor for which its library was compiled.

    Returns:
        The name that was written into PoCL's description of the device; None where nothing was written.
    """
    if not is_pocl(device) or not _is_misfit(device):
        return None
    place, name = _find_name(device)
    fitting = chosen_library(_flags(device)).processor
    if not name or name == fitting:
        return None
    _replace(place, fitting)
    return fitting


def _flags(device: cl.Device) -> frozenset[str]:
    """Return the processor's instruction sets as PoCL sees them.

    The width of its vectors follows from LLVM's list, in which AVX and AVX-512 may differ from Linux's.
    """
    width = device.native_vector_width_float
    wide = frozenset(name for name, needed in (("avx", 8), ("avx512f", 16)) if width >= needed)
    return instruction_sets() - {"avx", "avx512f"} | wide


def _is_misfit(device: cl.Device) -> bool:
    """Return whether this PoCL takes its library by instruction sets, and the processor's name from LLVM."""
    version = _version(device)
    return version is not None and version < _FITTING and _has_libraries()


def takes_bitcode(device: cl.Device) -> bool:
    """Return whether a device's driver is a PoCL that makes programs of LLVM's bitcode."""
    return is_pocl(device) and _version(device) == _OF_BITCODE


def _version(device: cl.Device) -> tuple[int, ...] | None:
    """Return the first two numbers of the driver's version; None where it has none."""
    match = re.match(r"(\d+)\.(\d+)", device.driver_version.strip())
    return None if match is None else tuple(map(int, match.groups()))


@functools.cache
def _has_libraries() -> bool:
    """Return whether PoCL has libraries for several processors, not only for the machine that compiled it.

    PoCL looks for them relative to its code.
    """
    try:
        with open("/proc/self/maps", encoding="utf-8", errors="replace") as file:
            places = {line.split()[-1] for line in file if "/libpocl" in line}
    except OSError:
        return False
    below = ("share/pocl", "../share/pocl", "../../share/pocl", "../../pocl_binary_distribution/.libs/share/pocl")
    folders = (Path(place).parent / folder for place in places for folder in below)
    return any(next(folder.glob("kernel-x86_64-*-avx2.bc"), None) for folder in folders)


def _find_name(device: cl.Device) -> tuple[int, str]:
    """Return where the device's description holds the address of its processor's name, and the name.

    The address follows the address of the target's name, ``x86_64-...``. Memory is read through Linux, which answers an
    invalid address with an error. The name is empty where there is no such pair.
    """
    try:
        memory = os.open("/proc/self/mem", os.O_RDONLY)
    except OSError:
        return 0, ""
    try:
        data = os.pread(memory, 8 * _WORDS, device.int_ptr)
        words = struct.unpack(f"<{len(data) // 8}Q", data[: len(data) // 8 * 8])
        for i in range(1, len(words) - 1):
            if _text(memory, words[i - 1]).startswith("x86_64-"):
                # Version 5 has the name of its library in between.
                i += _text(memory, words[i]).startswith("kernel-")
                return device.int_ptr + 8 * i, _text(memory, words[i])
    except OSError:
        pass
    finally:
        os.close(memory)
    return 0, ""


def _text(memory: int, address: int) -> str:
    """Return the text at an address; empty where the address is invalid."""
    try:
        return os.pread(memory, _NAME, address).split(b"\0")[0].decode("ascii", "replace")
    except (OSError, OverflowError):
        return ""


def _replace(place: int, name: str) -> None:
    """Replace a pointer by one to a new string, of the allocator with which PoCL would free it."""
    copy = ctypes.CDLL(None).strdup
    copy.restype, copy.argtypes = ctypes.c_void_p, [ctypes.c_char_p]
    ctypes.c_uint64.from_address(place).value = copy(name.encode())
