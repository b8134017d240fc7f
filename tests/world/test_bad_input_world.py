"""Bad input is refused with the exact message, and leaves no file behind."""

from __future__ import annotations

import pytest
from support.bad_input_grid import GRID_CASES
from support.bad_input_logs import LOG_CASES
from support.bad_input_maps import MAP_CASES
from support.bad_input_scanner import PARAMETER_CASES, SCANNER_CASES

CASES = [*GRID_CASES, *MAP_CASES, *SCANNER_CASES, *PARAMETER_CASES, *LOG_CASES]


@pytest.mark.parametrize(("action", "kind", "message"), CASES)
def test_bad_input(tmp_path, action, kind, message):
    with pytest.raises(kind) as caught:
        action(tmp_path)
    assert type(caught.value) is kind
    assert str(caught.value) == message.replace("{tmp}", str(tmp_path))
    assert {file.name for file in tmp_path.iterdir()} <= {"input"}
    assert not [file for file in tmp_path.rglob("*") if file.name.startswith(".")]
