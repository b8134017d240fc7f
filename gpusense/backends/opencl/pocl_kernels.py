"""Kernels that PoCL has compiled: kept between processes, with checksums.

PoCL keeps a program's kernels in files below ``<folder>/XX/YYY...``, named by a hash of the source and the options, and
loads them without a check. Its folder belongs to this process. The folder of a program is copied there from an entry of
the cache before the program is built, and back into an entry after its kernels have run.

For that hash PoCL preprocesses its own headers and the source, which takes 27 ms for each program. So a program is made
of its bitcode where the version of PoCL takes that, which takes 1 ms. PoCL names the kernels of bitcode by nothing but
the kernel's name and the size of its groups. Kernels are therefore compiled under a name that ends in a hash of all
that their code depends on.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import hashlib
import os
import re
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

from gpusense._util.private import UnsafeFolderError, check_private
from gpusense.backends.cache import restore_files, store_files
from gpusense.backends.scratch import scratch_folder

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
    """The compiled kernels of this process.

    Attributes:
        changed: Programs with kernels compiled since the last :meth:`save`, by the keys of their entries.
    """

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
