"""What is particular to PoCL, the OpenCL driver for processors that comes as a wheel.

A processor may be newer than the PoCL of the wheel, whose compiler then refuses to compile for it. PoCL asks LLVM for
the processor's name and hands the name back to it. LLVM 14 calls what it does not know (AMD's Zen 5, say) "generic",
and takes no such name: "unknown target CPU 'generic'" (pocl issue 1049). PoCL has no setting for the name, so it is
replaced where PoCL keeps it, by one that LLVM knows with the instruction sets of PoCL's own library.
"""

from __future__ import annotations

import ctypes
import os
import struct
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pyopencl as cl

# From the newest: instruction sets as Linux names them, and a processor that has them, as PoCL's own library does.
_PROCESSORS: tuple[tuple[set[str], str], ...] = (
    ({"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}, "skylake-avx512"),
    ({"avx2", "fma", "bmi2"}, "haswell"),
    ({"avx"}, "sandybridge"),
    (set(), "x86-64"),
)
# The words of a device's description in which its names are looked for.
_WORDS = 256
_NAME = 24


def is_pocl(device: cl.Device) -> bool:
    """Whether a device is one of PoCL's."""
    return "Portable Computing Language" in device.platform.name


def known_processor(flags: set[str]) -> str:
    """A processor LLVM 14 knows, with no instruction set that is not in ``flags``."""
    return next(name for needed, name in _PROCESSORS if needed <= flags)


def mend(device: cl.Device) -> str | None:
    """Give PoCL's device a processor's name its compiler knows; the name, or None where nothing is to be mended.

    The name stands behind that of the target, ``x86_64-...``, in the device's description; where the two are not found
    nothing is touched. Memory is read through the kernel, which answers an address that is none with an error.
    """
    if not is_pocl(device) or not os.path.exists("/proc/self/mem"):
        return None
    with open("/proc/self/mem", "rb", buffering=0) as memory:
        words = struct.unpack(f"<{_WORDS}Q", os.pread(memory.fileno(), 8 * _WORDS, device.int_ptr))
        for i in range(1, _WORDS):
            target, name = (_text(memory.fileno(), word) for word in words[i - 1 : i + 1])
            if target.startswith(b"x86_64-") and name == b"generic":
                known = known_processor(_instruction_sets())
                _replace(device.int_ptr + 8 * i, known)
                return known
    return None


def _text(memory: int, address: int) -> bytes:
    try:
        return os.pread(memory, _NAME, address).split(b"\0")[0]
    except (OSError, OverflowError):
        return b""


def _instruction_sets() -> set[str]:
    with open("/proc/cpuinfo", encoding="utf-8") as file:
        return next((set(line.split(":")[1].split()) for line in file if line.startswith("flags")), set())


def _replace(place: int, name: str) -> None:
    """Point to a new string, of the allocator that PoCL would free it with."""
    copy = ctypes.CDLL(None).strdup
    copy.restype, copy.argtypes = ctypes.c_void_p, [ctypes.c_char_p]
    ctypes.c_uint64.from_address(place).value = copy(name.encode())
