"""``explain()`` lists exactly the parts that a scene does not need, with reason and saving."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.model_world import INF, NAN, REPEATED, cloud, make, room, scan

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.world import windows


def left_out(model: Any) -> dict[str, str]:
    """Return the omissions that ``explain`` lists, by name."""
    lines = [line[2:] for line in model.explain().splitlines() if line.startswith("- ")]
    return dict(line.split("  ", 1) for line in lines)


def test_explain_names_what_is_left_out(monkeypatch):
    """Each omission has the number that decides it and its saving; scans are not mentioned before the first one."""
    monkeypatch.setattr(windows, "SMALLEST_CELLS", 1)
    grid = room((400, 500))
    z = scan(REPEATED)
    z[:4] = [NAN, INF, INF, -1.0]
    poses = np.column_stack([grid.cell_centers([200] * 9, range(245, 254)), np.zeros(9)])
    model = make("beam", grid, "numpy", REPEATED, weights=(0.9, 0.0, 0.1, 0.0), mount=(0.0, 0.0, 0.2), beams=12)
    always = {"short component", "rand component", "range_bias", "sigma_growth", "exponents in two parts"}
    assert set(left_out(model)) == always
    model.log_likelihood(poses, z)
    assert model.explain().startswith("beam model, float32, ")
    found = left_out(model)
    scene = {"missing readings", "max readings", "thinned beams", "repeated bearings", "entry from outside", "far map"}
    scene |= {"reduction of huge headings", "other worlds", "kernel arguments"}
    assert set(found) == always | scene
    assert "z_short = 0" in found["short component"] and "z_rand = 0" in found["rand component"]
    assert "2 of 24" in found["missing readings"] and "of 24" in found["max readings"]
    assert "10" in found["thinned beams"] and "of 400 x 500 cells" in found["far map"]
    assert all("; saves " in text for text in found.values())
    model.log_likelihood(poses, scan(REPEATED))
    assert not {"missing readings", "max readings"} & set(left_out(model))


def marked(model: Any, mark: str) -> dict[str, str]:
    """Return the lines of ``explain`` with a mark, by name."""
    lines = [line[2:] for line in model.explain().splitlines() if line.startswith(f"{mark} ")]
    return {name.strip(): why.strip() for name, why in (line.split("  ", 1) for line in lines)}


def test_what_is_kept_and_what_could_go():
    grid = room()
    p = gs.BeamParameters(0.8, 0.1, 0.1, 0.0, 0.004, range_bias=0.01)
    model = gs.BeamModel(grid, gs.Scanner([0.0, 0.5], 9.0), p, backend="numpy", precision="float64")
    model.log_likelihood(cloud(grid, 5), [1.0, 2.0])
    kept, could_go = marked(model, "+"), marked(model, "?")
    assert kept["hit component"] == "z_hit = 0.8" and kept["range_bias"] == "range_bias = 0.01"
    assert "above 64" in kept["exponents in two parts"] and {"log-domain sum", "float64"} <= set(kept)
    assert set(could_go) == {"float64", "rays behind readings"} and "z_short = 0" in could_go["rays behind readings"]
    assert not set(kept) & set(left_out(model))
    smooth = make("bilinear", grid, "numpy")
    assert "interpolation" in marked(smooth, "+") and "nearest" in marked(smooth, "?")["interpolation"]
    plain = make("field", grid, "numpy")
    assert not marked(plain, "?")


# Words of the kernel's text for a part of the density; parameters of a scene without and with the part.
PLAIN = dict(z_hit=0.7, z_short=0.1, z_max=0.1, z_rand=0.1)
PARTS = {
    "short component": ("short_length_lanes(expected", dict(PLAIN, z_hit=0.8, z_short=0.0), PLAIN),
    "hit component": ("hit_exponent_lanes(z", dict(PLAIN, z_hit=0.0, z_rand=0.8), PLAIN),
    "range_bias": ("TERM(range_bias)", PLAIN, dict(PLAIN, range_bias=0.1)),
    "sigma_growth": ("TERM(relative_growth)", PLAIN, dict(PLAIN, sigma_growth=0.01)),
    "exponents in two parts": ("two_product_lanes(off", PLAIN, dict(PLAIN, sigma_hit=0.004)),
}


@pytest.mark.parametrize("part", PARTS)
def test_the_text_of_the_kernel_lacks_what_is_left_out(part, needs):
    """In a scene that needs the part, the text has it, and ``explain`` says that it is kept."""
    words, without, with_part = PARTS[part]
    grid = room()
    backend = get_backend(needs("opencl"))
    scalar = {
        "short_length_lanes(expected": "short_peak(terms",
        "hit_exponent_lanes(z": "hit_exponent(z, expected, terms)",
        "TERM(range_bias)": "expected + terms->range_bias",
        "TERM(relative_growth)": "terms->relative_growth * expected",
        "two_product_lanes(off": "two_product(off",
    }
    words = words if backend.info.lanes > 1 else scalar[words]
    for parameters, listed in ((without, True), (with_part, False)):
        model = gs.BeamModel(grid, gs.Scanner([0.0, 0.5], 9.0), gs.BeamParameters(**parameters), backend=backend)
        assert model.sources() == {}
        model.log_likelihood(cloud(grid, 5), [1.0, 2.0])
        (text,) = [text for name, text in model.sources().items() if name in ("score_beams", "beam_tiles")]
        assert (part in left_out(model)) == listed
        assert (words in text) != listed
        assert (part in marked(model, "+")) != listed


@pytest.mark.long
@pytest.mark.sampled(1, without="warp:cpu")
def test_measured_savings(backend):
    grid = room()
    model = make("beam", grid, backend)
    with pytest.raises(RuntimeError, match="measure: must follow a call of log_likelihood"):
        model.explain(measure=True)
    poses, z = cloud(grid, 20), scan()
    before = model.log_likelihood(poses, z)
    plain, timed = model.explain().splitlines(), model.explain(measure=True).splitlines()
    assert len(plain) == len(timed)
    for line, with_time in zip(plain, timed, strict=True):
        assert with_time.startswith(line)
        rest = with_time[len(line) :]
        assert not rest or (
            line.startswith("- ") and (rest == "; not timed" or ("; measured " in rest and rest.endswith(" ms")))
        )
    assert sum("; measured " in line for line in timed) >= 2
    # The model is unchanged.
    assert "EXACT_EXPONENT" not in model.explain().splitlines()[1]
    np.testing.assert_array_equal(model.log_likelihood(poses, z), before)


# ------------------------------------------------------------------------------------- what the last cloud left out
