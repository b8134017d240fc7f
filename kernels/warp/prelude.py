"""What every kernel file begins with: the meaning of ``real``, and how a kernel is compiled.

Flags are those of ``gpusense.signatures``. A factory turns them into closure constants; Warp drops the branches of
``if FLAG:`` whose condition is such a constant, so code that a set of flags does not need is never generated. Numbers
are such constants too, negative ones of their own: some versions of Warp lose the sign of ``-ONE`` in float64.
"""

import functools
import inspect
from types import SimpleNamespace

import warp as wp

# Ranges are the same bits on every device only if products and sums are rounded one by one (fuse_fp reaches the
# compilers as a ban on fused multiply-add) and division correctly, which CUDA does unless fast_math is on.
OPTIONS = {"fuse_fp": False, "fast_math": False, "enable_backward": False}

# Every launch has a thread for each work-item, so none need look for another one; older Warp always lets them.
_ONE_EACH = {"grid_stride": False} if "grid_stride" in inspect.signature(wp.kernel).parameters else {}

# A decorator: the kernel and the functions that it calls become a module of their own, named by their contents.
kernel = wp.kernel(module="unique", enable_backward=False, module_options=OPTIONS, **_ONE_EACH)


@functools.cache
def precision(flags):
    """The scalar and vector types of a set of flags: real, vec2, vec4."""
    if "FLOAT64" in flags:
        return SimpleNamespace(real=wp.float64, vec2=wp.vec2d, vec4=wp.vec4d)
    return SimpleNamespace(real=wp.float32, vec2=wp.vec2f, vec4=wp.vec4f)


# The work-item of a launch of one dimension, given wp.tid(): there Warp divides by a number that is 1, of 64 bits.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
return blockIdx.x * blockDim.x + threadIdx.x;
#else
return tid;
#endif
""")
def work_item(tid: wp.int32) -> wp.int32: ...


_C_TYPES = {wp.float32: "float", wp.float64: "double", wp.int32: "int", wp.uint16: "unsigned short"}


@functools.cache
def reader(dtype, count=1):
    """A function of (array, i) that reads numbers or vectors which the kernel does not write; i must not be negative.

    Arrays are contiguous and begin at multiples of 16 bytes. Warp's subscripts would add the length to a negative i,
    multiply by a stride of 64 bits and load vectors number by number: ten instructions in place of two on GPUs. There
    vectors are loaded whole; on processors they are not, whose compilers make no vectors of loops that load vectors.
    With a count so many neighbours are read as one vector; i must be a multiple of it.
    """
    per_element = getattr(dtype, "_length_", 1)
    scalar = getattr(dtype, "_wp_scalar_type_", dtype)
    one, length = _C_TYPES[scalar], per_element * count
    if length == 1:
        loads, whole, single = [], "__ldg(values.data + i)", "values.data[i]"
    else:
        # The widest load is of 16 bytes.
        width = min(length, 16 // wp.types.type_size_in_bytes(scalar))
        loads = [
            f"const {one}{width} part{k} = __ldg(reinterpret_cast<const {one}{width} *>(values.data + i) + {k});"
            for k in range(length // width)
        ]
        numbers = ", ".join(f"part{k}.{name}" for k in range(length // width) for name in "xyzw"[:width])
        whole = f"wp::vec_t<{length}, {one}>({numbers})"
        numbers = ", ".join(f"values.data[i + {k // per_element}].c[{k % per_element}]" for k in range(length))
        single = f"wp::vec_t<{length}, {one}>({numbers})"
    lines = ["#if defined(__CUDA_ARCH__)", *loads, f"return {whole};", "#else", f"return {single};", "#endif", ""]
    result = dtype if count == 1 else wp.types.vector(length=length, dtype=scalar)

    @wp.func_native("\n".join(lines))
    def read(values: wp.array(dtype=dtype), i: wp.int32) -> result: ...

    return read


@functools.cache
def writer(dtype):
    """A function of (array, i, value) that writes a number, like ``reader``."""

    @wp.func_native("values.data[i] = value;")
    def write(values: wp.array(dtype=dtype), i: wp.int32, value: dtype): ...

    return write


@functools.cache
def fused(real):
    """A function of (a, b, c): a b + c, on GPUs with one rounding; only where a bound covers either."""

    @wp.func_native("#if defined(__CUDA_ARCH__)\nreturn fma(a, b, c);\n#else\nreturn a * b + c;\n#endif\n")
    def multiply_add(a: real, b: real, c: real) -> real: ...

    return multiply_add


# How many bits are set.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
return __popc(bits);
#else
return __builtin_popcount(bits);
#endif
""")
def popcount(bits: wp.int32) -> wp.int32: ...
