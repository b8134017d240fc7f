"""Flags of kernels by the conditions on which they depend."""

from __future__ import annotations

import functools


@functools.lru_cache(maxsize=4096)
def flags_if(**conditions: object) -> frozenset[str]:
    """Return the flags whose conditions hold: ``flags_if(HIT=z_hit > 0, RAND=z_rand > 0)``."""
    return frozenset([flag for flag, holds in conditions.items() if holds])
