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

import atexit
import contextlib
import ctypes
import functools
import hashlib
import os
import re
import struct
import threading
from collections.abc import Callable, Iterator, Sequence, Set
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from gpusense._util.private import UnsafeFolderError, check_private
from gpusense.backends.cache import restore_files, store_files
from gpusense.backends.processor import instruction_sets
from gpusense.backends.scratch import scratch_folder

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
    """Make PoCL compile for the processor of its library; return the name that was written, or None."""
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
    """Return whether PoCL has, next to its code, libraries for several processors, not only for its build machine."""
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


# ---- kernels that PoCL has compiled: kept between processes, with checksums
#
# PoCL keeps a program's kernels in files below ``<folder>/XX/YYY...``, named by a hash of the source and the options,
# and loads them without a check. Its folder belongs to this process; a program's folder is copied there from an entry
# of the cache before the program is built, and back after its kernels have run. For that hash PoCL preprocesses its
# headers and the source, 27 ms a program, so a program is made of its bitcode where the version of PoCL takes that, in
# 1 ms. PoCL names kernels of bitcode by the kernel's name and the size of its groups alone: kernels get names that end
# in a hash.


# Files that PoCL reads again: programs, and kernels for a group size.
_ENDINGS = (".bc", ".so")
_BITCODE = "program.bc"
# Suffix of a unique kernel name.
_OWN = re.compile(r"_[0-9a-f]{24}$")

_Program = TypeVar("_Program")


def own_name(kernel: str, key: str) -> str:
    """Return the name of a kernel that no kernel of another program has."""
    return f"{kernel}_{_hash(key)}"


def source_name(name: str) -> str:
    """Return the name that a kernel has in its source."""
    return _OWN.sub("", name)


def _hash(key: str) -> str:
    return hashlib.sha256(key.encode()).hexdigest()[:24]


def _has_kernel(file: Path, kernels: Sequence[str]) -> bool:
    """Return whether bitcode has one of these kernels: another thread may have compiled a program meanwhile."""
    bitcode = file.read_bytes()
    return any(name.encode() in bitcode for name in kernels)


class PoclKernels:
    """The compiled kernels of this process; ``changed``: keys of programs with kernels compiled since :meth:`save`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._lock = threading.RLock()
        # By the keys of entries: the folders of a program, the files that its entry holds.
        self._folders: dict[str, set[str]] = {}
        self._saved: dict[str, frozenset[str]] = {}
        self.changed: set[str] = set()
        self._process = os.getpid()
        atexit.register(self._save_all)

    @contextlib.contextmanager
    def building(self, key: str) -> Iterator[None]:
        """Restore the entry of a program before it is built, and note the folders that PoCL makes for it."""
        with self._lock:
            if key not in self._folders:
                self._saved[key] = restore_files(key, self.folder)
                self._folders[key] = {"/".join(name.split("/")[:2]) for name in self._saved[key]}
            before = self._listed()
            yield
            self._folders[key] |= self._listed() - before
            self.changed.add(key)

    def built(
        self, key: str, kernels: Sequence[str], compiled: Callable[[], _Program], loaded: Callable[[bytes], _Program]
    ) -> _Program:
        """Return a program, made of its bitcode; it is compiled where its entry has none."""
        file = self.folder / _hash(key) / _BITCODE
        with self._lock, self.building(key):
            self._folders[key] |= {file.parent.name, *kernels}
            if not file.is_file():
                before = self._listed()
                program = compiled()
                # No folder exists if a program has already loaded PoCL with another folder.
                written = (self.folder / name for name in self._listed() - before)
                try:
                    os.rename(
                        next(folder for folder in written if _has_kernel(folder / _BITCODE, kernels)), file.parent
                    )
                except (StopIteration, OSError):
                    return program
            return loaded(file.read_bytes())

    def mark(self, key: str) -> None:
        """Note that a kernel of a program runs for the first time, for which PoCL compiles it."""
        with self._lock:
            self.changed.add(key)

    def save(self) -> None:
        """Put compiled kernels into entries of the cache; all launches must have ended."""
        with self._lock:
            changed, self.changed = self.changed, set()
            for key in changed:
                names = frozenset(self._files(key))
                # The next process recompiles kernels that cannot be read.
                if names - self._saved.get(key, frozenset()) and store_files(key, self.folder, names):
                    self._saved[key] = names

    def _save_all(self) -> None:
        """Save the kernels of all programs at exit; a forked child saves none."""
        if os.getpid() != self._process:
            return
        self.changed |= self._folders.keys()
        self.save()

    def _listed(self) -> set[str]:
        """Return the folders of all programs."""
        folders = set()
        with contextlib.suppress(OSError):
            for first in os.scandir(self.folder):
                if len(first.name) == 2 and first.is_dir():
                    folders |= {f"{first.name}/{second.name}" for second in os.scandir(first.path)}
        return folders

    def _files(self, key: str) -> Iterator[str]:
        """Yield the files of a program that PoCL reads again."""
        for folder in self._folders[key]:
            for path in (self.folder / folder).rglob("*"):
                if path.suffix in _ENDINGS and not path.name.startswith("temp"):
                    yield path.relative_to(self.folder).as_posix()


def trouble_of_own_folder() -> str:
    """Return why PoCL's default folder is not safe; empty if it is safe or absent."""
    if chosen := os.environ.get("POCL_CACHE_DIR"):
        folder = chosen
    elif base := os.environ.get("XDG_CACHE_HOME"):
        folder = f"{base}/pocl/kcache"
    else:
        folder = f"{os.environ['HOME']}/.cache/pocl/kcache" if os.environ.get("HOME") else "/tmp/pocl/kcache"
    try:
        check_private(Path(os.path.realpath(folder)))
    except UnsafeFolderError as error:
        return f"PoCL was used before gpusense and loads kernels from {folder}: {error}; set POCL_CACHE_DIR to another"
    except OSError:
        # Nothing can be loaded from there.
        return ""
    return ""


@functools.cache
def pocl_kernels() -> PoclKernels:
    """Return the kernels of this process."""
    folder = scratch_folder() / "pocl"
    folder.mkdir(exist_ok=True)
    return PoclKernels(folder)
