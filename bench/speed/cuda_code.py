"""Count the machine instructions of a Warp kernel compiled for a CUDA device; no GPU is needed.

    python bench/speed/cuda_code.py field_blocks --flags LOG_TABLE,TWO_PART_POINTS,ROUNDED_CELLS,INSIDE --terms 16

Prints all instructions by kind, and the longest stretch without branches: the body of an unrolled loop, which computes
--terms readings. Needs NVIDIA's ``nvdisasm`` (from PyPI: nvidia-cuda-nvdisasm; part of CUDA's tools).
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

import warp as wp

from gpusense.interface.flags import FLAGS
from gpusense.interface.kernel_files import warp_files
from gpusense.interface.signatures import KERNELS

_INSTRUCTION = re.compile(r"/\*[0-9a-f]{4,}\*/\s+(?:@!?U?P\w+\s+)?([A-Z]\w*)")
_ENDS = {"BRA", "CALL", "EXIT", "RET", "BSYNC", "WARPSYNC"}


def disassembled(kernel: str, flags: frozenset[str], arch: int, nvdisasm: str) -> str:
    """Return the machine code of a kernel as text."""
    made = warp_files().kernel_of(kernel, flags)
    with tempfile.TemporaryDirectory() as folder:
        wp.compile_aot_module(made.module, arch=arch, module_dir=folder, use_ptx=False)
        (code,) = Path(folder).glob("*.cubin")
        command = [nvdisasm, "--print-code", str(code)]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def stretches(text: str) -> list[list[str]]:
    """Return the names of the instructions of each stretch between labels and branches."""
    found: list[list[str]] = [[]]
    for line in text.splitlines():
        match = _INSTRUCTION.search(line)
        if line.startswith(".L"):
            found.append([])
        elif match is not None:
            found[-1].append(match.group(1))
            if match.group(1) in _ENDS:
                found.append([])
    return found


def described(names: list[str], terms: int) -> str:
    """Describe instructions: their number, the number per term, and their kinds."""
    kinds = ", ".join(f"{name} {count}" for name, count in Counter(names).most_common())
    return f"{len(names)} instructions, {len(names) / terms:.4g} a term: {kinds}"


def main() -> int:
    """Count and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kernel", choices=sorted(KERNELS))
    parser.add_argument("--flags", default="", help="with commas between them, of gpusense/interface/flags.py")
    parser.add_argument("--arch", type=int, default=90, help="compute capability without its point")
    parser.add_argument("--terms", type=int, default=1, help="readings that the longest stretch computes")
    parser.add_argument("--nvdisasm", default=shutil.which("nvdisasm"), help="the program's path")
    arguments = parser.parse_args()
    flags = frozenset(filter(None, arguments.flags.split(",")))
    if unknown := flags - FLAGS.keys():
        parser.error(f"argument --flags: not known: {', '.join(sorted(unknown))}")
    if arguments.nvdisasm is None:
        parser.error("argument --nvdisasm: the program is not on the path")
    text = disassembled(arguments.kernel, flags, arguments.arch, arguments.nvdisasm)
    found = stretches(text)
    print(f"{arguments.kernel}, {', '.join(sorted(flags)) or 'no flags'}, compute capability {arguments.arch}")
    print("whole kernel:", described([name for names in found for name in names], 1))
    print("longest stretch:", described(max(found, key=len), arguments.terms))
    return 0


if __name__ == "__main__":
    sys.exit(main())
