"""Unset flags leave no trace in the code; Warp's code rounds each operation and is made once."""

from __future__ import annotations

import functools
import re
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.kernel_scenes import PRECISIONS, scene_flags

from gpusense.backends import get_backend
from gpusense.interface.flags import FLAGS
from gpusense.interface.kernel_files import warp_files
from gpusense.interface.signatures import KERNELS
from gpusense.interface.sources import assemble, relevant

# Kernel, the flag, further flags, and patterns of the flag's code in OpenCL and in Warp's C++.
TRACES = [
    ("sum_parts", "SCANS", (), r"\bcounts\[", r"address\(var_counts\b"),
    ("cast_ranges", "FLOAT64", (), r"\bdouble\b", r"\bfloat64\b"),
    ("cast_ranges", "ORIGINS_OUTSIDE", (), r"\benter_x\b", r"\bwp::neg\("),
    (
        "cast_ranges",
        "MARCH",
        (),
        r"\btolerance \+",
        r"\bwp::float32\* *var_map_table|array_t<wp::float32> var_map_table",
    ),
    ("score_beams", "SENSOR_TABLE", ("LINEAR",), r"\btabulated_density\(z", r"tabulated_density_\d+\("),
    ("score_beams", "HIT", ("LINEAR", "RAND"), r"\berf\(", r"\bwp::erf\("),
    ("score_beams", "SHORT", ("LINEAR", "RAND"), r"\btanh\(", r"\bwp::tanh\("),
    ("score_beams", "SHARED_RAYS", ("RAND", "LINEAR"), r"\bfirst\[", r"address\(var_first\b"),
    ("score_beams", "ALL_READINGS", ("RAND", "LINEAR"), r"\bisnan\(", r"\bwp::isnan\("),
    ("score_beams", "PER_BEAM", ("RAND", "LINEAR"), r"\bparts\[\(long\)n \* readings", r"array_store\(var_parts\b"),
    ("score_beams", "CONES", ("RAND", "LINEAR"), r"\bnearest_echo\(map_table", r"nearest_echo_\d+\("),
    ("score_beams", "INCIDENCE", ("RAND", "LINEAR", "CONES"), r"\bincidence_terms\(", r"incidence_terms_\d+\("),
    ("place_poses", "TWO_PART_POINTS", (), r"\bpose_low\[", r"array_store\(var_pose_low\b"),
    ("place_poses", "POSES_FLOAT32", (), r"\bfloat coordinate\b", r"array_t<wp::float32>"),
    ("place_poses", "HUGE_HEADINGS", (), r"\breduce_huge\(", r"reduce_huge_\d+\("),
    ("place_inputs", "RANGES_FLOAT32", (), r"\bfloat measured\b", r"array_t<wp::float32> var_ranges"),
    ("place_inputs", "SOME_BEAMS", (), r"return ranges\[beam\[k\]\]", r"address\(var_beam\b"),
    ("place_inputs", "END_POINTS", (), r"\bguard_scale \*", r"array_store\(var_guard\b"),
    ("cast_ranges", "SECTORS_2", (), r"define SECTORS 2$", r"var_speed_y > var_speed_x"),
    ("cast_ranges", "SECTORS_4", (), r"\b2\.4142136\b", r"\b2\.41421"),
    ("cast_ranges", "ROW_GROUPS", (), r"\brow / GROUP\b", r"wp::floordiv\("),
    ("cast_tiles", "ORDERED", (), r"\border\[", r"address\(var_order\b"),
    ("beam_tiles", "STRANDED", ("RAND", "LINEAR"), r"\bsum \+= term", r"tile_group_\d+\("),
    ("sum_parts", "CUBES", (), r"\blog\(", r"\bwp::log\("),
    ("field_blocks", "ROUNDED_CELLS", ("LOG_TABLE", "TWO_PART_POINTS"), r"\brounded_cell\(", r"rounded_cell_\d+\("),
    (
        "field_blocks",
        "INSIDE",
        ("LOG_TABLE", "TWO_PART_POINTS", "ROUNDED_CELLS"),
        r"\(uint\)near\.y \* ",
        r"table_cell_\d+\([^{;]*\{[^}]*wp::mul\(",
    ),
    ("score_beacons", "RAND", (), r"\beither\(log_p, terms->random", r"(?:either_\d+\([\s\S]*){4}"),
    ("score_field", "SCANS", ("LOG_TABLE",), r"\bstart\[", r"address\(var_start\b"),
    ("score_features", "RANGE", (), r"\brange_mass\(", r"range_mass_\d+\("),
    ("score_features", "BEARING", (), r"\bangle_pair\(", r"angle_pair_\d+\("),
    ("score_features", "SIGNATURE", (), r"\bSIGNATURE_AT\]", r"pair_product_\d+\("),
    ("score_features", "FIELD", ("BEARING",), r"\bfield_mass\(", r"field_mass_\d+\("),
    ("score_features", "LINE", ("RANGE", "BEARING"), r"\boverlaps\(", r"overlaps_\d+\("),
    ("score_features", "KNOWN", ("RANGE",), r"= partner\[k\]", r"address\(var_partner\b"),
    ("score_features", "MARGINAL", ("RANGE",), r"\badd_term\(\*sum", r"(?:\bwp::exp\([\s\S]*){2}"),
    ("score_field", "HIT", ("LINEAR",), r"\bexp\(", r"\bwp::exp\("),
    ("score_field", "TWO_PART_POINTS", ("LOG_TABLE",), r"\bcareful_offset\(", r"careful_offset_\d+\("),
    ("score_field", "BILINEAR", ("LINEAR",), r"\bbilinear\(", r"bilinear_\d+\("),
    ("e_step", "INFORMATION", ("HIT", "SHORT", "RAND"), r"\bsums\[38\]", r"\bvec_t<39\b"),
]
traces = pytest.mark.parametrize(
    ("kernel", "flag", "beside", "opencl", "warp"),
    TRACES,
    ids=[f"{t[0]}-{t[1]}-beside-{'-'.join(t[2])}" for t in TRACES],
)


def without_comments(source: str) -> str:
    return re.sub(r"//.*", "", source)


@traces
def test_flags_that_are_off_leave_no_trace_in_opencl(
    kernel: str, flag: str, beside: tuple[str, ...], opencl: str, warp: str
) -> None:
    file = KERNELS[kernel].file
    assert re.search(opencl, without_comments(assemble(file, frozenset({flag, *beside}))), re.MULTILINE)
    source = assemble(file, frozenset(beside))
    assert not re.search(opencl, without_comments(source), re.MULTILINE)
    # The head tests at compile time whether the device fuses.
    assert "#if" not in source.split("#line 1", 1)[1]


@pytest.mark.sampled(1)
@pytest.mark.sampled(0.08)
@traces
def test_flags_that_are_off_leave_no_trace_in_warp(
    kernel: str, flag: str, beside: tuple[str, ...], opencl: str, warp: str, needs: Callable[[str], str]
) -> None:
    needs("warp")
    assert re.search(warp, warp_code(kernel, frozenset({flag, *beside})))
    assert not re.search(warp, warp_code(kernel, frozenset(beside)))


@functools.cache
def warp_code(kernel: str, flags: frozenset[str]) -> str:
    """Return the C++ that Warp generates for a kernel, without comments, which quote the Python source."""
    import warp as wp

    made = warp_files().kernel_of(kernel, flags)
    with tempfile.TemporaryDirectory() as folder:
        wp.compile_aot_module(made.module, device="cpu", module_dir=folder)
        (source,) = Path(folder).glob("*.cpp")
        return without_comments(source.read_text(encoding="utf-8"))


def cuda_code(kernel: str, flags: frozenset[str], folder: Path) -> str:
    """Return the PTX that Warp makes of a kernel for a CUDA device."""
    import warp as wp

    architectures = wp.get_cuda_supported_archs()
    if not architectures:
        pytest.skip("this build of Warp has no CUDA compiler")
    made = warp_files().kernel_of(kernel, flags)
    arch = min(architectures, key=lambda number: abs(number - 90))
    wp.compile_aot_module(made.module, arch=arch, module_dir=folder, use_ptx=True)
    (code,) = folder.glob("*.ptx")
    return code.read_text(encoding="utf-8")


def cuda_operations(kernel: str, flags: frozenset[str], folder: Path) -> set[str]:
    """Return the floating-point operations that round in Warp's code of a kernel for a CUDA device."""
    return cuda_operations_of(cuda_code(kernel, flags, folder))


def cuda_operations_of(code: str) -> set[str]:
    return set(re.findall(r"\b(?:fma|mad|mul|add|sub|div|rcp)\.\S*f(?:32|64)\b", code))


@pytest.mark.parametrize("kernel", ["cast_ranges", "cast_tiles"])
@pytest.mark.parametrize("precision", PRECISIONS)
def test_cuda_code_rounds_every_operation_by_itself(
    precision: type, kernel: str, needs: Callable[[str], str], tmp_path: Path
) -> None:
    needs("warp")
    operations = cuda_operations(kernel, scene_flags(precision, "ORIGINS_OUTSIDE"), tmp_path)
    bits = "f64" if precision is np.float64 else "f32"
    assert {f"rcp.rn.{bits}"} <= operations <= {f"{name}.rn.{bits}" for name in ("mul", "add", "sub", "div", "rcp")}


@pytest.mark.parametrize("precision", PRECISIONS)
def test_cuda_code_places_poses_by_rounded_operations(
    precision: type, needs: Callable[[str], str], tmp_path: Path
) -> None:
    needs("warp")
    places = (tmp_path / "ordinary", tmp_path / "huge")
    ordinary, huge = (
        cuda_operations("place_poses", scene_flags(precision, "TWO_PART_POINTS", *names), place)
        for names, place in zip(((), ("HUGE_HEADINGS",)), places, strict=True)
    )
    assert {"div.rn.f64"} <= ordinary <= {f"{name}.rn.f64" for name in ("mul", "add", "sub", "div")}
    # Reducing a huge heading takes the rounding errors of products.
    assert huge - ordinary == {"fma.rn.f64"}


def test_cuda_code_of_a_block_of_the_field_loads_as_little_as_can_be(
    needs: Callable[[str], str], tmp_path: Path
) -> None:
    needs("warp")
    flags = frozenset({"LOG_TABLE", "TWO_PART_POINTS", "ROUNDED_CELLS", "INSIDE"})
    code = cuda_code("field_blocks", flags, tmp_path)
    operations = cuda_operations_of(code)
    # Positions of end points with an error bound fuse products and sums.
    assert "fma.rn.f32" in operations <= {f"{name}.rn.f32" for name in ("mul", "add", "sub", "fma")}
    blocks = re.split(r"^\$L\w+:|\bbra\b.*", code.partition(".entry")[2], flags=re.MULTILINE)
    whole = max(blocks, key=len)
    loads = re.findall(r"\bld\.global\S*", whole)
    # Loads of 16 readings, a point for two of them and a cell for each, by address: no strides, no checks of signs.
    assert sorted(loads) == ["ld.global.nc.f32"] * 16 + ["ld.global.nc.v4.f32"] * 8
    assert not re.search(r"\bmul\.lo\.s64\b|\bshr\.s32\b", whole)


@pytest.mark.sampled(0.2)
@pytest.mark.parametrize("kernel", [*KERNELS])
def test_a_warp_kernel_is_made_once_for_the_flags_that_matter(kernel: str, needs: Callable[[str], str]) -> None:
    backend = get_backend(needs("warp"))
    all_flags = frozenset(FLAGS)
    file = KERNELS[kernel].file
    assert backend.compile(kernel, all_flags) is backend.compile(kernel, relevant(file, all_flags))
    with pytest.raises(ValueError, match="flags: must be among"):
        backend.compile(kernel, frozenset({"NO_SUCH_FLAG"}))
