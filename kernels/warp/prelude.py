"""What every kernel file begins with: the meaning of ``real``, and how a kernel is compiled.

Flags are those of ``gpusense.signatures``. A factory turns them into closure constants; Warp drops the branches of
``if FLAG:`` whose condition is such a constant, so code that a set of flags does not need is never generated. Numbers
are such constants too, negative ones of their own: some versions of Warp lose the sign of ``-ONE`` in float64.
"""

import functools
from types import SimpleNamespace

import warp as wp

# Ranges are the same bits on every device only if products and sums are rounded one by one (fuse_fp reaches the
# compilers as a ban on fused multiply-add) and division correctly, which CUDA does unless fast_math is on.
OPTIONS = {"fuse_fp": False, "fast_math": False, "enable_backward": False}

# A decorator: the kernel and the functions that it calls become a module of their own, named by their contents.
kernel = wp.kernel(module="unique", enable_backward=False, module_options=OPTIONS)


@functools.cache
def precision(flags):
    """The scalar and vector types of a set of flags: real, vec2, vec4."""
    if "FLOAT64" in flags:
        return SimpleNamespace(real=wp.float64, vec2=wp.vec2d, vec4=wp.vec4d)
    return SimpleNamespace(real=wp.float32, vec2=wp.vec2f, vec4=wp.vec4f)
