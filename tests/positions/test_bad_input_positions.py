"""Bad input to position functions is refused with the exact message."""

from __future__ import annotations

import pytest
from support.bad_input_positions import CASES


@pytest.mark.parametrize(("action", "kind", "message"), CASES)
def test_bad_input(action, kind, message):
    with pytest.raises(kind) as caught:
        action()
    assert type(caught.value) is kind
    assert str(caught.value) == message
