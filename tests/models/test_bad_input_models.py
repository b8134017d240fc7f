"""Bad input to models and casters is refused with the exact message, and leaves them usable."""

from __future__ import annotations

import numpy as np
import pytest
from support.bad_input_models import CASES, CASTER, FIELD, GRID, MODEL, POSE, SCAN

import gpusense as gs


@pytest.mark.parametrize(("action", "kind", "message"), CASES)
def test_bad_input(action, kind, message):
    with pytest.raises(kind) as caught:
        action()
    assert type(caught.value) is kind
    assert str(caught.value) == (message if isinstance(message, str) else message())


def test_messages_are_one_line_that_names_the_argument():
    for _, _, message in CASES:
        text = message if isinstance(message, str) else message()
        argument, rule = text.split(": ", 1)
        assert (" must " in f" {rule}" or "is not installed" in rule) and ", got " in rule and "\n" not in text
        assert argument.replace(" + ", "").isidentifier(), text


def test_models_work_after_refusals():
    """The models that refused everything above still score."""
    fresh = gs.BeamModel(MODEL.grid, MODEL.scanner, backend="numpy")
    np.testing.assert_array_equal(MODEL.log_likelihood(POSE, SCAN), fresh.log_likelihood(POSE, SCAN))
    fresh = gs.LikelihoodFieldModel(FIELD.grid, FIELD.scanner, backend="numpy")
    np.testing.assert_array_equal(FIELD.log_likelihood(POSE, SCAN), fresh.log_likelihood(POSE, SCAN))
    assert CASTER.cast(POSE, [0.0]).tolist() == [[1.5]]


def test_a_value_just_above_a_limit_is_not_shown_as_the_limit():
    with pytest.raises(ValueError, match="range_max: must be at most 1048576 cells of the grid, got ") as caught:
        gs.RayCaster(GRID, 1048576.25, backend="numpy")
    assert not str(caught.value).endswith("got 1048576")


@pytest.mark.parametrize("selection", ["numpy:", "opencl:", "warp:"])
def test_a_selection_that_ends_in_a_colon_is_refused(selection):
    with pytest.raises(ValueError, match="backend: "):
        gs.RayCaster(GRID, 5.0, backend=selection)


def test_large_arrays_do_not_fill_the_message():
    for beams in (np.zeros((40, 40)), np.zeros((40, 40), int), [[0.0] * 500]):
        with pytest.raises(TypeError, match="beams: ") as caught:
            gs.BeamModel(MODEL.grid, MODEL.scanner, backend="numpy", beams=beams)
        assert len(str(caught.value)) < 250 and "\n" not in str(caught.value)
