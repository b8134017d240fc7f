"""Kernels of the beam model and the likelihood field agree with the reference on the same inputs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.kernel_scenes import (
    EXACT,
    GRIDS,
    LASER,
    NO_CROWD,
    ONE_SCAN,
    SCALE,
    adversarial_poses,
    assert_near,
    directions,
    nothing,
    on_both,
    one_world,
    planes_of,
    ranges_on_both,
    run,
    scene_flags,
    window_of,
)
from support.score_scenes import FIELD_SCENES, FIELDS, MIXTURES, field_scene, mixture, scan

from gpusense.backends import Backend, get_backend
from gpusense.evaluation.tolerances import differing, per_beam, per_scan
from gpusense.interface.structs import Score, Window, columns
from gpusense.reference.mixture import log_density

# Each set of flags is compiled. Components, precision and the rest of the kernel have separate lines of code, so each
# mixture has a plain scene in float32 and a full one in float64, and two mixtures have all four.
FULL = ("ALL_READINGS", "ORIGINS_OUTSIDE", "SHARED_RAYS")
BEAMS = [*((name, *case) for name in MIXTURES for case in (((), np.float32), (FULL, np.float64)))]
BEAMS += [(name, *case) for name in ("book", "hit and short") for case in (((), np.float64), (FULL, np.float32))]


@pytest.mark.sampled(0.12)
@pytest.mark.parametrize(("name", "names", "real"), BEAMS)
def test_beams_agree_with_the_reference(name: str, names: tuple[str, ...], real: type, device: Backend) -> None:
    occupied = GRIDS["rooms"]
    flags, terms = mixture(name, real, z_max=0.05)
    flags = scene_flags(real, "PER_BEAM", *flags, *names)
    cell, pose = adversarial_poses(occupied, real, outside="ORIGINS_OUTSIDE" in names)
    cell, pose = cell[:60], pose[:60]
    ray = directions(real)
    expected, _ = ranges_on_both(get_backend("numpy"), occupied, real, flags, cell, pose)
    repeats = np.full(len(ray), 1)
    if "SHARED_RAYS" in names:
        repeats[::3], repeats[1::5] = 3, 0
    first = np.append(0, np.cumsum(repeats)).astype(np.int32)
    expected = np.repeat(expected, repeats, axis=1)
    reading = scan(expected[9], real, all_readings="ALL_READINGS" in names)
    count, readings, fixed, temperature = len(pose), len(reading), -3.25, 0.5
    parts = np.full((count, readings), np.nan, real)
    found = run(
        device, "score_beams", flags, (count,), planes_of(occupied), *one_world(real),
        nothing(real, 2), cell, pose, ray, first, reading,
        terms, nothing(real), nothing(real), nothing(real), first, nothing(real), np.empty(count, real), parts,
        window_of(occupied), count, len(ray), readings, *LASER, EXACT, SCALE, NO_CROWD,
        Score(fixed, temperature), ONE_SCAN,
    )  # fmt: skip

    # The truth: the float64 reference on the same rounded readings, terms and expected ranges.
    z = np.broadcast_to(reading.astype(np.float64), expected.shape)
    wide = flags | {"FLOAT64"}
    with np.errstate(all="ignore"):
        truth = log_density(wide, z, expected.astype(np.float64), columns("MixtureTerms", terms.astype(np.float64)))
    truth = np.where(np.isnan(z), 0.0, np.where(np.isinf(z), float(columns("MixtureTerms", terms).z_max[0]), truth))
    assert_near(found["parts"], truth, per_beam(truth, real))
    total = temperature * (truth.sum(axis=1) + fixed)
    assert_near(found["log_p"], total, per_scan(truth, real, fixed=fixed, temperature=temperature))


def test_no_readings_give_exactly_what_is_fixed(device: Backend) -> None:
    occupied, real = GRIDS["rooms"], np.float32
    flags, terms = mixture("book", real, z_max=0.05)
    cell, pose = adversarial_poses(occupied, real, outside=False)
    count, none = len(pose), np.zeros(0, real)
    found = run(
        device, "score_beams", frozenset(flags), (count,), planes_of(occupied), *one_world(real),
        nothing(real, 2), cell, pose,
        np.zeros((0, 2), real), np.zeros(1, np.int32), none, terms, none, none, none, np.zeros(1, np.int32), none,
        np.empty(count, real), none, window_of(occupied), count, 0, 0, *LASER, EXACT, SCALE, NO_CROWD,
        Score(-1.5, 1.0), ONE_SCAN,
    )  # fmt: skip
    assert (found["log_p"] == -1.5).all()


# ---- the likelihood field


def score_field(device: Backend, flags: frozenset[str], scene: dict[str, np.ndarray], *fixed: float) -> Any:
    """Return the outputs of the field kernel on the reference and on a device."""
    real, (rows, cols) = scene["pose"].dtype, scene["table"].shape
    count, readings = scene["parts"].shape
    finite = scene["point"][np.isfinite(scene["point"])]
    guard = 8 * np.finfo(real).eps * (np.abs(finite).max(initial=0.0) + 2)
    table, *others = scene.values()
    return on_both(
        device, "score_field", flags, (count,), table, *one_world(real), *others, Window(0, 0, rows - 4, cols - 4),
        count, readings, guard, Score(*fixed), ONE_SCAN, NO_CROWD,
    )  # fmt: skip


@pytest.mark.sampled(0.2)
@pytest.mark.parametrize(("name", "names", "real"), FIELD_SCENES)
def test_fields_agree_with_the_reference(name: str, names: tuple[str, ...], real: type, device: Backend) -> None:
    flags = scene_flags(real, "PER_BEAM", *FIELDS[name], *names)
    scene = field_scene(name, real, all_readings="ALL_READINGS" in names)
    fixed, temperature = -2.5, 0.75
    reference, found = score_field(device, flags, scene, fixed, temperature)
    if name == "log table":
        assert differing(found["parts"], reference["parts"]) == 0
    truth = reference["parts"].astype(np.float64)
    # Each may be off by the bound.
    assert_near(found["parts"], truth, 2 * per_beam(truth, real))
    total = temperature * (truth.sum(axis=1) + fixed)
    assert_near(found["log_p"], total, 2 * per_scan(truth, real, fixed=fixed, temperature=temperature))


def test_quick_cells_change_no_bit(device: Backend) -> None:
    whole = field_scene("log table", np.float32, all_readings=False)
    count = len(whole["pose"])
    for readings in (1, 16, 17, whole["parts"].shape[1]):
        scene = whole | {name: whole[name][:readings] for name in ("point", "point_low")}
        scene["parts"] = np.full((count, readings), np.nan, np.float32)
        plain = scene_flags(np.float32, *FIELDS["log table"], "TWO_PART_POINTS")
        _, expected = score_field(device, plain, scene, -2.5, 0.75)
        _, found = score_field(device, plain | {"ROUNDED_CELLS"}, scene, -2.5, 0.75)
        assert differing(found["log_p"], expected["log_p"]) == 0


def test_an_impossible_end_point_makes_the_scan_impossible(device: Backend) -> None:
    scene = field_scene("log table", np.float32, all_readings=False)
    scene["table"][5:9] = -np.inf
    flags = frozenset({"LOG_TABLE", "LINEAR", "HIT", "TWO_PART_POINTS"})
    reference, found = score_field(device, flags, scene, 0.0, 1.0)
    assert np.isneginf(reference["log_p"]).any()
    assert not np.isnan(found["log_p"]).any()
    np.testing.assert_array_equal(np.isneginf(found["log_p"]), np.isneginf(reference["log_p"]))


def test_low_parts_of_poses_are_read_only_where_they_are_needed(device: Backend) -> None:
    scene = field_scene("log table", np.float32, all_readings=False)
    flags = frozenset({"LOG_TABLE", "LINEAR", "HIT", "PER_BEAM"})
    _, expected = score_field(device, flags, scene, 0.0, 1.0)
    _, found = score_field(device, flags, scene | {"pose_low": scene["pose_low"][:1]}, 0.0, 1.0)
    assert differing(found["parts"], expected["parts"]) == 0
