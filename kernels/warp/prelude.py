"""The loader of kernel files, and functions that all of them use.

A kernel file is executed once for each set of flags. ``from .flags import HIT`` gives it the truth of a flag of
``gpusense.interface``, ``from .types import real`` a type of the flags' precision, and ``from .caster import cast_ray``
a function of the flags' caster. An import from another kernel file gives that file's names for the same flags, from
``.float64`` for the same flags in float64. Warp drops the branches of ``if FLAG:`` whose condition is such a constant,
so code that a set of flags does not need is never generated. Numbers are such constants too. A negative number has a
separate constant: some versions of Warp lose the sign of ``-ONE`` in float64.
"""

import builtins
import functools
import inspect
import re
import sys
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType, SimpleNamespace

import warp as wp

from gpusense.interface import casters, structs
from gpusense.interface.flags import FLAGS
from gpusense.interface.signatures import KERNELS

# Ranges have the same bits on every device only if each product and sum is rounded by itself and division is correctly
# rounded. fuse_fp=False bans fused multiply-add; CUDA divides correctly unless fast_math is on.
OPTIONS = {"fuse_fp": False, "fast_math": False, "enable_backward": False}

# Every launch has a thread per work-item, so no thread needs a loop over work-items; older versions of Warp always have
# it.
_ONE_EACH = {"grid_stride": False} if "grid_stride" in inspect.signature(wp.kernel).parameters else {}

# Decorator of functions that stay calls, where this version of Warp can do so: their numbers occupy no registers
# of the loops of their caller, and they are compiled once.
apart = functools.partial(wp.func, inline=False) if "inline" in inspect.signature(wp.func).parameters else wp.func

_module = wp.kernel(module="unique", enable_backward=False, module_options=OPTIONS, **_ONE_EACH)
_FOLDER = Path(__file__).parent
_IMPORTED = re.compile(r"^ *from (\.+)([\w.]*) import", re.MULTILINE)
# Flags that choose types.
_PRECISION = frozenset({"FLOAT64", "POSES_FLOAT32", "RANGES_FLOAT32"})


def kernel(body):
    """Mark a kernel; ``kernel_of`` types its parameters."""
    return body


@functools.cache
def kernel_of(name, flags):
    """Return a kernel by its row of the signature table, which names and types its parameters.

    The kernel and the functions that it calls become a separate module, named by their contents.

    Raises:
        TypeError: The parameters' names differ from the row.
    """
    return typed(getattr(file_of(KERNELS[name].file, flags), name), flags)


def typed(body, flags):
    """Return the kernel of a marked function."""
    row = KERNELS[body.__name__].arguments
    names = tuple(inspect.signature(body).parameters)
    if names != tuple(argument.name for argument in row):
        raise TypeError(f"{body.__name__}: parameters must be those of its row, got {', '.join(names)}")
    types = _argument_types(flags) | {"entry": body.__globals__.get("ENTRY")}
    body.__annotations__ = {
        argument.name: types[argument.type] if argument.shape is None else wp.array(dtype=types[argument.type])
        for argument in row
    }
    return _module(body)


def file_of(name, flags=frozenset()):
    """Return the module of a kernel file (``"beam"``, ``"lanes.math"``) for a set of flags."""
    return _executed(name, flags & _relevant(name))


@functools.cache
def _executed(name, flags):
    """Execute a kernel file."""
    here = name.split(".")

    def imported(target, scope=None, local=None, names=(), level=0):
        if level == 0:
            return __import__(target, scope, local, names, level)
        first, *rest = [*here[: len(here) - level], *target.split(".")]
        if first == "prelude":
            return sys.modules[__name__]
        if first in ("flags", "types"):
            return precision(flags) if first == "types" else _switches(flags)
        if first == "float64":
            return file_of(".".join(rest), flags | {"FLOAT64"})
        return file_of(casters.caster_file(flags) if first == "caster" else ".".join([first, *rest]), flags)

    loader, module = _loader(name), ModuleType(f"{__package__}.{name}")
    module.__file__, module.__builtins__ = loader.path, vars(builtins) | {"__import__": imported}
    exec(loader.get_code(module.__name__), vars(module))
    return module


def _loader(name):
    """Return the loader of a kernel file, which keeps its bytecode."""
    return SourceFileLoader(f"{__package__}.{name}", str(_FOLDER.joinpath(*name.split(".")).with_suffix(".py")))


@functools.cache
def _relevant(name):
    """Return the flags that may change a kernel file: flags that it or a file that it imports names, and of types."""
    if name == "caster":
        files = [entry.file for entry in casters.ENTRIES.values()]
        return frozenset(casters.FLAGS).union(*map(_relevant, files))
    if name in ("flags", "prelude"):
        return frozenset()
    if name == "types":
        return _PRECISION
    text, here = _loader(name).get_data(_loader(name).path).decode(), name.split(".")
    files = {".".join([*here[: len(here) - len(dots)], target]) for dots, target in _IMPORTED.findall(text)}
    named = FLAGS.keys() & set(re.findall(r"\w+", text))
    return frozenset(named).union(*(_relevant(file.removeprefix("float64.")) for file in files))


@functools.cache
def _switches(flags):
    """Return the truth of each flag by name."""
    return SimpleNamespace(**{flag: flag in flags for flag in FLAGS})


@functools.cache
def _argument_types(flags):
    """Return the types of the signature table by name, for a set of flags."""
    types = precision(flags)
    return vars(types) | {
        "real2": types.vec2,
        "real4": types.vec4,
        "int": wp.int32,
        "int2": wp.vec2i,
        "uchar": wp.uint8,
        "ushort": wp.uint16,
        "double": wp.float64,
    }


@functools.cache
def precision(flags):
    """Return the types of a set of flags: real, vec2, vec4, of poses and readings, and the structs by name."""
    real, vec2, vec4 = (wp.float64, wp.vec2d, wp.vec4d) if "FLOAT64" in flags else (wp.float32, wp.vec2f, wp.vec4f)
    made = {name: _struct(name, real if "real" in structs.fields(name).values() else None) for name in structs.STRUCTS}
    coordinate = wp.float32 if "POSES_FLOAT32" in flags else wp.float64
    measured = wp.float32 if "RANGES_FLOAT32" in flags else wp.float64
    return SimpleNamespace(real=real, vec2=vec2, vec4=vec4, coordinate=coordinate, measured=measured, **made)


@functools.cache
def _struct(name, real):
    """Make a struct; those without real numbers are the same in both precisions."""
    kinds = {"int": wp.int32, "real": real, "double": wp.float64}
    fields = {field: kinds[kind] for field, kind in structs.fields(name).items()}
    return wp.struct(type(name, (), {"__annotations__": fields, "__module__": __name__}))


@functools.cache
def doubles(module):
    """Return the numbers of a module as float64, and its tuples and lists as vectors of float64 or of words."""
    made = ModuleType(module.__name__)
    for name, value in vars(module).items():
        if isinstance(value, float):
            value = wp.float64(value)
        elif isinstance(value, (tuple, list)):
            dtype = wp.float64 if isinstance(value[0], float) else wp.uint32
            value = wp.types.vector(length=len(value), dtype=dtype)(*value)
        setattr(made, name, value)
    return made


def by_device(gpu, processor):
    """Make C++ that returns the value of one expression on GPUs, and of another on processors."""
    return f"#if defined(__CUDA_ARCH__)\nreturn {gpu};\n#else\nreturn {processor};\n#endif\n"


# Return the work-item of a launch of one dimension, given wp.tid(), which divides a number of 64 bits by 1.
@wp.func_native(by_device("blockIdx.x * blockDim.x + threadIdx.x", "tid"))
def work_item(tid: wp.int32) -> wp.int32: ...


_C_TYPES = {
    wp.float32: "float",
    wp.float64: "double",
    wp.int32: "int",
    wp.uint16: "unsigned short",
    wp.uint8: "unsigned char",
}


@functools.cache
def reader(dtype, count=1):
    """Make a function of (array, i) that reads numbers or vectors; i >= 0, and the kernel must not write the array.

    Arrays are contiguous and begin at multiples of 16 bytes. Warp's subscripts would add the length to a negative i,
    multiply by a stride of 64 bits and load vectors number by number: ten instructions in place of two on GPUs. On GPUs
    vectors are loaded whole. On processors they are not, since compilers make no vector code of loops that load
    vectors. count reads as many neighbours as one vector; i must be a multiple of it.
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
        inside = "" if per_element == 1 else ".c[{}]"
        numbers = ", ".join(
            f"values.data[i + {k // per_element}]{inside.format(k % per_element)}" for k in range(length)
        )
        single = f"wp::vec_t<{length}, {one}>({numbers})"
    lines = ["#if defined(__CUDA_ARCH__)", *loads, f"return {whole};", "#else", f"return {single};", "#endif", ""]
    result = dtype if count == 1 else wp.types.vector(length=length, dtype=scalar)

    @wp.func_native("\n".join(lines))
    def read(values: wp.array(dtype=dtype), i: wp.int32) -> result: ...

    return read


@functools.cache
def field_readers(struct):
    """Make functions of (array,) by field name that read a field of the first struct of an array, like ``reader``."""

    def make(field):
        kind, place = struct.vars[field].type, f"values.data->{field}"

        @wp.func_native(by_device(f"__ldg(&{place})", place))
        def read(values: wp.array(dtype=struct)) -> kind: ...

        return read

    return SimpleNamespace(**{field: make(field) for field in struct.vars})


@functools.cache
def behind(dtype):
    """Make a function of (array, count) that returns the array without its first ``count`` numbers."""
    if hasattr(dtype, "_wp_scalar_type_"):
        native = f"wp::vec_t<{dtype._length_}, {_C_TYPES[dtype._wp_scalar_type_]}>"
    else:
        native = f"wp::{dtype.__name__}"

    @wp.func_native(f"wp::array_t<{native}> rest = values; rest.data += count; return rest;")
    def rest_of(values: wp.array(dtype=dtype), count: wp.int64) -> wp.array(dtype=dtype): ...

    return rest_of


@functools.cache
def loader(dtype):
    """Make a function of (array, i) that reads a number, like ``reader``, of an array that the kernel writes."""

    @wp.func_native("return values.data[i];")
    def load(values: wp.array(dtype=dtype), i: wp.int32) -> dtype: ...

    return load


@functools.cache
def writer(dtype):
    """Make a function of (array, i, value) that writes a number, like ``reader``."""

    @wp.func_native("values.data[i] = value;")
    def write(values: wp.array(dtype=dtype), i: wp.int32, value: dtype): ...

    return write


@functools.cache
def fused(real):
    """Make a function of (a, b, c) that returns a b + c, with one rounding on GPUs; callers' bounds must cover both."""

    @wp.func_native(by_device("fma(a, b, c)", "a * b + c"))
    def multiply_add(a: real, b: real, c: real) -> real: ...

    return multiply_add


# Return whether the device has fused multiply-add, as decided at compile time.
@wp.func_native("""
#if defined(__CUDA_ARCH__) || defined(__FMA__) || defined(__ARM_FEATURE_FMA)
return true;
#else
return false;
#endif
""")
def fuses() -> bool: ...


# Return whether the device is a GPU, which multiplies and adds at once.
@wp.func_native(by_device("true", "false"))
def on_gpu() -> bool: ...


@functools.cache
def exact_fma(real):
    """Make a function of (a, b, c) that returns a b + c with one rounding; on some processors a slow call."""
    name = "__builtin_fma" if real == wp.float64 else "__builtin_fmaf"

    @wp.func_native(by_device("fma(a, b, c)", f"{name}(a, b, c)"))
    def multiply_add(a: real, b: real, c: real) -> real: ...

    return multiply_add


@functools.cache
def log1p_of_gpu(real):
    """Make a function that returns log(1 + x) on a GPU; processors have none that compiled kernels may call."""
    name = "log1p" if real == wp.float64 else "log1pf"

    @wp.func_native(by_device(f"{name}(x)", "x"))
    def log1p(x: real) -> real: ...

    return log1p


# Return the number of bits that are set.
@wp.func_native(by_device("__popc(bits)", "__builtin_popcount(bits)"))
def popcount(bits: wp.int32) -> wp.int32: ...
