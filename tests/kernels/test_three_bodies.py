"""A concept has three bodies, in OpenCL, Warp and NumPy: functions of the same names in the same order."""

from __future__ import annotations

import ast
import functools
import re
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import pytest

import gpusense.reference
from gpusense.interface.kernel_files import kernel_root, opencl_source
from gpusense.interface.signatures import KERNELS

OPENCL, WARP, NUMPY = LANGUAGES = "OpenCL", "Warp", "NumPy"
FOLDERS = {WARP: kernel_root() / "warp", NUMPY: Path(gpusense.reference.__file__).parent}
# Files of a single language that are not concepts.
OTHER_FILES = {
    WARP: {"__init__": "makes the folder a package", "prelude": "loads all Warp kernels"},
    NUMPY: {
        "__init__": "makes the folder a package",
    },
}


@dataclass(frozen=True)
class Purpose:
    """Functions of a concept that only some languages have, with the reason."""

    concept: str
    functions: str
    languages: tuple[str, ...]
    reason: str


ARRAYS = "works on all elements at once"
COUNTS = "counts of boundaries are integers in the bits of a float; in NumPy numbers"
FLOOR = "some OpenCL drivers call floor and clamp as functions; Warp and NumPy have their own"
FLOAT64 = "error_free.cl has the precision of real, which may be float32; Warp and NumPy choose it by the call"
EIGHT = "a work-item reads eight numbers before it uses any; the reference takes all of them at once"
BLOCKS = "a work-item reads blocks of 16 readings as sets of bits; the reference takes all readings at once"
TILES = "a work-item of a GPU finds its particle and rays; the reference takes all of them at once"
TEAMS = "work-items of a GPU share points or steps; the reference takes all of them at once"
LANES = "bodies in lanes take the function from the scalar text; Warp and NumPy have no such bodies"
QUICK = "kernels round end points first and repeat the doubtful ones with twice the digits; the reference repeats all"
STAGES = "on Warp's processor device each stage of a block is a loop; OpenCL has lanes for it"
WORLD_BY_WORLD = "a work-item moves pointers to its world; the reference takes all particles of a world at once"
KERNELS_ONLY, REFERENCE_ONLY = (OPENCL, WARP), (NUMPY,)

ON_PURPOSE = [
    Purpose("absolute", "log_position log_heading", (OPENCL,), LANES),
    Purpose("beacons", "log_ranges", (OPENCL,), LANES),
    Purpose("beam", "readings_of_scan", (WARP, NUMPY), "OpenCL moves pointers to a scan's beginning"),
    Purpose("beam", "strands_of", (WARP,), STAGES),
    Purpose("beam", "sum_terms", REFERENCE_ONLY, ARRAYS),
    Purpose("bits", "lowest_bit highest_bit", KERNELS_ONLY, "the reference unpacks words to bool"),
    Purpose("bits", "occupied_at", (WARP,), "OpenCL counts the cells of four columns from words"),
    Purpose("bits", "unpacked", REFERENCE_ONLY, "the reference unpacks words to bool"),
    Purpose("circles", "point_of add_error", KERNELS_ONLY, "points come one after another"),
    Purpose("distance", "_lines _lowest", REFERENCE_ONLY, ARRAYS),
    Purpose("distance", "parabola", KERNELS_ONLY, "the reference lowers all cells of a line at each distance"),
    Purpose("echo", "echoes", REFERENCE_ONLY, ARRAYS),
    Purpose("end_point", "within", (OPENCL,), FLOOR),
    Purpose("end_point", "rounding_margin rounded_cell table_origin table_cell", KERNELS_ONLY, QUICK),
    Purpose("error_free", "floor_int", (OPENCL,), FLOOR),
    Purpose("error_free", "add_strands", KERNELS_ONLY, "the reference adds the terms of strand_sums"),
    Purpose("error_free", "strands_in block_sums strand_sums _sums", REFERENCE_ONLY, ARRAYS),
    Purpose("error_free", "to_real", (OPENCL,), LANES),
    Purpose("error_free", "scaled_sum", KERNELS_ONLY, ARRAYS),
    Purpose("field_climb", "add_over_members", KERNELS_ONLY, "the reference has no teams"),
    Purpose("error_free", "where_pair", (OPENCL, NUMPY), LANES),
    Purpose("estimate", "add_pose", (OPENCL,), LANES),
    Purpose("field", "rounded_block", KERNELS_ONLY, QUICK),
    Purpose("field", "field_log", KERNELS_ONLY, "sum_terms of beam.py does it for both models"),
    Purpose("field", "staged_sum", (WARP,), STAGES),
    Purpose("field_gradient", "add_slope add_readings", KERNELS_ONLY, "readings come one after another"),
    Purpose("field_term", "quick_value careful_value", KERNELS_ONLY, QUICK),
    Purpose("field_term", "interpolated", (WARP,), STAGES),
    Purpose("field_term", "log_square", (OPENCL,), LANES),
    Purpose("heading", "cos_sin_of", (OPENCL,), LANES),
    Purpose("heading", "two_sum_float64 high_half_float64 pair_product_float64", (OPENCL,), FLOAT64),
    Purpose("hit_shape", "mass_place mass_at", (WARP,), STAGES),
    Purpose("field_term", "_near", REFERENCE_ONLY, ARRAYS),
    Purpose("ranges", "cast_in_worlds", REFERENCE_ONLY, WORLD_BY_WORLD),
    Purpose("rectangles", "put_runs put_four", (WARP,), "OpenCL has pointers"),
    Purpose("worlds", "fours_of put_four", (WARP,), "OpenCL has pointers"),
    Purpose("sums", "particles_of_scans", REFERENCE_ONLY, "a work-item finds its scan by a division"),
    Purpose("raycast", "sectors_of", REFERENCE_ONLY, "SECTORS is a constant of the kernels"),
    Purpose("shapes", "particles_of_worlds", REFERENCE_ONLY, WORLD_BY_WORLD),
    Purpose(
        "shapes",
        "seen_between directions_of_disc directions_of_segment sight_at shape_at relative_shape box_numbers meet_shape "
        "covered_rays",
        KERNELS_ONLY,
        "a ray tests the shapes near its direction; in the reference it tests every shape",
    ),
    Purpose(
        "ranges",
        "by_team members team_memory share_pairs mark_pairs owner_of one_of size_of begin_at keep_least least_at wait",
        (WARP,),
        "a kernel in OpenCL has its team's memory",
    ),
    Purpose("icp_step", "add_to_blocks close_blocks", KERNELS_ONLY, "points come one after another"),
    Purpose("icp_step", "log_share add_over_team add_joint_blocks", KERNELS_ONLY, TEAMS),
    Purpose("icp_step", "block_squares", REFERENCE_ONLY, ARRAYS),
    Purpose(
        "landmark_grid", "squared_reach with_landmark", KERNELS_ONLY,
        "kernels look at landmarks one by one and shrink the disc; the reference evaluates all in the disc",
    ),
    Purpose("landmark_grid", "candidates", REFERENCE_ONLY, ARRAYS),
    Purpose("landmarks", "negative_where at_places", REFERENCE_ONLY, ARRAYS),
    Purpose("landmarks", "add_signature", (OPENCL,), LANES),
    Purpose("learning", "add_causes", (OPENCL,), LANES),
    Purpose("line_fit", "line_at", KERNELS_ONLY, ARRAYS),
    Purpose("log_terms", "in_any", (OPENCL,), LANES),
    Purpose("motion", "any_of motion_of move_by", (OPENCL,), LANES),
    Purpose("beam_consistency", "floor_of", (OPENCL,), FLOOR),
    Purpose("beam_consistency", "walkers", (WARP,), "OpenCL has get_local_size"),
    Purpose("beam_consistency", "least_of_team", KERNELS_ONLY, TEAMS),
    Purpose("beam_consistency", "_cells_along", REFERENCE_ONLY, ARRAYS),
    Purpose("philox", "number_of", (OPENCL,), LANES),
    Purpose("placement", "move_to_sensor", (OPENCL,), LANES),
    Purpose("placement", "floor_cells", (OPENCL,), FLOOR),
    Purpose("ranges", "caster_of", REFERENCE_ONLY, "kernels import the file caster, which their loaders resolve"),
    Purpose("raycast", "track_of rectangle_at", KERNELS_ONLY, COUNTS),
    Purpose("ray", "as_bits farther", (WARP,), "OpenCL has casts of bits, as_bits and as_real; NumPy needs none"),
    Purpose("ray", "whole", KERNELS_ONLY, COUNTS),
    Purpose("ray", "start_casts", REFERENCE_ONLY, ARRAYS),
    Purpose("rectangles", "reached _runs longest _quadrants", REFERENCE_ONLY, ARRAYS),
    Purpose("relative", "pair_sum_float64", (OPENCL,), FLOAT64),
    Purpose("weighing", "sum_of write_eight", (OPENCL,), LANES),
    Purpose("weighing", "eight_at sum_eight sum_before", KERNELS_ONLY, EIGHT),
    Purpose("scan", "count_informative read_block chosen_of placed_of longest_beside fill_item", KERNELS_ONLY, BLOCKS),
    Purpose("score_cells", "within8 block_indices", (OPENCL,), "eight points at once, on processors"),
    Purpose("score_cells", "block_index", KERNELS_ONLY, "the reference clamps each cell by itself"),
    Purpose("score_cells", "cell_index", REFERENCE_ONLY, ARRAYS),
    Purpose("search", "_quarters_of", REFERENCE_ONLY, ARRAYS),
    Purpose("search", "left_by_team", KERNELS_ONLY, "the reference has no teams"),
    Purpose("search_ends", "periods", KERNELS_ONLY, "NumPy's division of integers rounds down"),
    Purpose("search_ends", "cell_of", (OPENCL,), FLOOR),
    Purpose("segments", "add_row", KERNELS_ONLY, "points come one after another, added by rotations"),
    Purpose("segments", "with_point", (WARP,), "OpenCL's functions take pointers to rows"),
    Purpose("segments", "running_costs rows_of _solve", REFERENCE_ONLY, ARRAYS),
    Purpose("ray", "tile_place tile_group tile_ray tile_step", KERNELS_ONLY, TILES),
]  # fmt: skip

CONCEPTS = sorted(path.stem for path in (kernel_root() / "opencl").glob("*.cl"))
each_concept = pytest.mark.parametrize("concept", CONCEPTS)


def opencl_functions(text: str) -> list[str]:
    """Return the names of an OpenCL file's functions and kernels, in order, from both branches of each #if."""
    code = re.sub(r"//[^\n]*", "", text)
    definition = r"^(?!typedef|#)(?:[a-zA-Z_][\w()]*[\s*]+)+(\w+)\([^;{}]*\)\s*\{"
    return list(dict.fromkeys(re.findall(definition, code, re.MULTILINE)))


def python_functions(text: str) -> list[str]:
    """Return the names of a Python file's functions in order, including nested ones."""
    found = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef)]
    found.sort(key=lambda node: node.lineno)
    return list(dict.fromkeys(node.name for node in found))


@functools.cache
def functions(concept: str, language: str) -> list[str]:
    """Return the names of a concept's functions in a language, in order."""
    if language == OPENCL:
        return opencl_functions(opencl_source(concept))
    return python_functions((FOLDERS[language] / f"{concept}.py").read_text(encoding="utf-8"))


@each_concept
def test_bodies_have_the_same_functions(concept):
    allowed = {name: row.languages for row in ON_PURPOSE if row.concept == concept for name in row.functions.split()}
    for language in LANGUAGES:
        others = {name for other in LANGUAGES for name in functions(concept, other)}
        missing = others - set(functions(concept, language))
        unexplained = sorted(name for name in missing if name not in allowed)
        assert not unexplained, f"{concept} lacks {unexplained} in {language}"


@each_concept
def test_bodies_have_their_functions_in_the_same_order(concept):
    for one, other in combinations(LANGUAGES, 2):
        both = set(functions(concept, one)) & set(functions(concept, other))
        orders = [[name for name in functions(concept, language) if name in both] for language in (one, other)]
        assert orders[0] == orders[1], f"{concept}: {one} and {other}"


@pytest.mark.parametrize("row", ON_PURPOSE, ids=[f"{row.concept}-{row.functions.split()[0]}" for row in ON_PURPOSE])
def test_every_exception_is_needed_and_true(row):
    assert row.reason
    for name in row.functions.split():
        assert tuple(language for language in LANGUAGES if name in functions(row.concept, language)) == row.languages
    assert row.languages != LANGUAGES


def test_no_exception_stands_twice():
    names = [(row.concept, name) for row in ON_PURPOSE for name in row.functions.split()]
    assert len(names) == len(set(names))


@pytest.mark.parametrize("language", OTHER_FILES)
def test_all_other_files_are_explained(language):
    files = {path.stem for path in FOLDERS[language].glob("*.py")}
    assert files - set(CONCEPTS) == set(OTHER_FILES[language])
    assert files >= set(CONCEPTS)
    assert all(OTHER_FILES[language].values())


@pytest.mark.parametrize("language", LANGUAGES)
def test_every_kernel_of_the_signature_table_is_found(language):
    for kernel, row in KERNELS.items():
        assert kernel in functions(row.file, language), f"{row.file} in {language}"
