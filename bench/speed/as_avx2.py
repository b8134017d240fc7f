"""Run a script with PoCL as on a processor without AVX-512, at the speed of this processor.

    python bench/speed/as_avx2.py bench/speed/options.py --backend opencl --rounds 30
    python bench/speed/as_avx2.py bench/speed/options.py --backend opencl

PoCL's compiler asks by the instruction ``xgetbv`` which registers the system saves. A copy of PoCL's wheel has ``push
7; pop rax`` in place of its three bytes, ``0f 01 d0``: registers of AVX but not of AVX-512. Kernels are then compiled
for ``haswell``, as ``gpusense devices`` shows. Code that PoCL does not compile, such as numba's, keeps AVX-512.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

PACKAGES = ("pyopencl", "pocl_binary_distribution")
# The register's number, 0, is set by ``xor ecx, ecx``; elsewhere the same bytes are not an instruction.
SET, READ, CLAIM = b"\x31\xc9", b"\x0f\x01\xd0", b"\x6a\x07\x58"


def copy_driver(folder: Path) -> Path:
    """Copy PoCL's wheel without AVX-512, and return the file that names the driver."""
    for package in PACKAGES:
        spec = importlib.util.find_spec(package)
        if spec is None or not spec.submodule_search_locations:
            raise FileNotFoundError(f"{package}: must be installed from its wheel")
        libraries = Path(next(iter(spec.submodule_search_locations))) / ".libs"
        shutil.copytree(libraries, folder / package / ".libs")
    (driver,) = (folder / PACKAGES[0] / ".libs").glob("libpocl*.so*")
    code = driver.read_bytes()
    if SET + READ not in code:
        raise ValueError(f"{driver.name}: must ask for registers by xgetbv, got another PoCL than version 3's wheel")
    driver.write_bytes(code.replace(SET + READ, SET + CLAIM))
    named = folder / "pocl.icd"
    named.write_text(f"{driver}\n")
    return named


def main() -> int:
    """Run a script, and return its exit code."""
    if len(sys.argv) < 2 or sys.argv[1].startswith("-"):
        print(__doc__)
        return 2
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        places = {"OCL_ICD_VENDORS": str(copy_driver(folder)), "GPUSENSE_CACHE_DIR": str(folder / "cache")}
        # common.py states it in the command of a report.
        places["GPUSENSE_BENCH_THROUGH"] = "bench/speed/as_avx2.py"
        return subprocess.run([sys.executable, *sys.argv[1:]], env=os.environ | places, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
