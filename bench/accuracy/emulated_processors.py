"""Prove PoCL on other processors, whose instruction sets QEMU's user mode emulates.

    python bench/accuracy/emulated_processors.py --output bench/results/emulated_processors

Needs ``qemu-x86_64`` (Debian: qemu-user) and PoCL's wheel. For each processor the proof of
``gpusense.evaluation.proof`` runs in an emulated interpreter: LLVM and PoCL see the emulated CPUID, and an instruction
that the processor lacks ends the process. QEMU shows the host's /proc/cpuinfo, so a file gives the processor's flags.
It emulates AVX2, but neither AVX-512 nor AMD's FMA4 and XOP; NumPy's wheels need SSE 4.2.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import ROOT, make_parser, parse, publish, table

_NEHALEM = "sse sse2 pni ssse3 cx16 sse4_1 sse4_2 popcnt"
_HASWELL = f"{_NEHALEM} avx f16c avx2 fma abm bmi1 bmi2 movbe"
# QEMU's model, and the flags that Linux lists on the emulated machine.
PROCESSORS = {
    "Nehalem": _NEHALEM,
    "SandyBridge": f"{_NEHALEM} avx",
    "IvyBridge": f"{_NEHALEM} avx f16c",
    "Haswell-noTSX": _HASWELL,
    "EPYC-Rome": _HASWELL,
    # LLVM goes by the model and calls it skylake-avx512; QEMU hides AVX-512, as a hypervisor may.
    "Skylake-Server-v3": _HASWELL,
}
_PROOF = """
import dataclasses, json, sys
sys.path[:] = json.loads(sys.argv[1])
from gpusense.backends import processor
processor._CPUINFO = sys.argv[2]
from gpusense.backends.opencl import devices, pocl
info, device = next((i, d) for i, d in devices.list_devices() if "Portable Computing Language" in i.driver)
print(json.dumps({"named": pocl._find_name(device)[1], "target": info.target, "lanes": info.lanes}), flush=True)
from gpusense.evaluation.proof import prove
prove({"info": dataclasses.asdict(info)}, lambda said: print(json.dumps(said), flush=True))
"""


def proved(model: str, flags: str) -> dict[str, Any]:
    """Run the proof on one processor and return its outcome."""
    with tempfile.TemporaryDirectory() as folder:
        cpuinfo = Path(folder) / "cpuinfo"
        cpuinfo.write_text(f"processor\t: 0\nmodel name\t: {model}\nflags\t\t: {flags}\n")
        path = json.dumps([str(ROOT), *(entry for entry in sys.path if entry)])
        python = os.path.realpath(sys.executable)
        command = ["qemu-x86_64", "-cpu", model, python, "-P", "-c", _PROOF, path, str(cpuinfo)]
        places = {"GPUSENSE_PROOF": "off", "GPUSENSE_CACHE_DIR": folder, "XDG_CACHE_HOME": folder}
        begin = time.perf_counter()
        done = subprocess.run(command, env=os.environ | places, capture_output=True, text=True, check=False)
        seconds = time.perf_counter() - begin
    said = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    facts: dict[str, Any] = said[0] if said else {}
    ended = bool(said) and said[-1] == {"end": True}
    begun = [str(report["begin"]) for report in said if "begin" in report]
    failure = "" if ended else next((str(r["wrong"]) for r in said if "wrong" in r), f"exit code {done.returncode}")
    return {"processor": model, **facts, "proved": list(dict.fromkeys(begun)), "failure": failure, "seconds": seconds}


def main() -> int:
    """Run the proofs and write; the exit code is 1 where one fails."""
    parser = make_parser(__doc__, backend="")
    parser.add_argument("--processor", action="append", choices=PROCESSORS, help="default: all")
    arguments = parse(parser)
    if shutil.which("qemu-x86_64") is None:
        parser.error("qemu-x86_64 is not installed (Debian: qemu-user)")
    rows = [proved(model, PROCESSORS[model]) for model in arguments.processor or PROCESSORS]
    columns = ("processor", "LLVM's name", "target", "lanes", "proved", "s")
    named = ("named", "target", "lanes")
    lines = [
        [r["processor"], *(r.get(name, "-") for name in named), r["failure"] or ", ".join(r["proved"]),
         f"{r['seconds']:.0f}"] for r in rows
    ]  # fmt: skip
    publish(__file__, arguments, table(columns, lines), {"rows": rows}, "Emulated by QEMU.")
    return int(any(row["failure"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
