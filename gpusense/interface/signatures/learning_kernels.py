"""Kernels that learn parameters."""

from __future__ import annotations

from gpusense.interface.signatures.rows import Kernel, kernel

# Readings and expected ranges to learn from, in blocks of equal length, and the mixture.
_PAIRS = (
    "real reading [blocks * readings]",
    "real expected [blocks * readings]",
    "MixtureTerms terms [1]",
    "real masses [1]",
)

KERNELS: dict[str, Kernel] = {
    "e_step": kernel(
        "learning", "block", *_PAIRS, "out real sums [blocks * width]", "int blocks", "int readings",
        "int across", "int along", "int width",
    ),
    "pair_causes": kernel(
        "learning", "block", *_PAIRS, "out real4 causes [blocks * readings]", "int blocks",
        "int readings", "int across", "int along",
    ),
}  # fmt: skip
