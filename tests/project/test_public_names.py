"""Public names: one table, of which the stub for type checkers is made."""

import pytest
from support import public_names

import gpusense as gs


def test_the_stub_is_that_of_the_table():
    text = public_names.STUB.read_text(encoding="utf-8")
    assert text == public_names.stub(), "run PYTHONPATH=tests python -m support.public_names"


def test_every_name_is_listed_once_and_completes():
    assert len(gs.__all__) == len(set(gs.__all__)) == 1 + sum(map(len, gs._NAMES.values()))
    assert {*gs.__all__, *gs._MODULES} == set(dir(gs))


@pytest.mark.parametrize("name", dir(gs))
def test_every_name_is_there(name):
    assert getattr(gs, name) is getattr(gs, name) is not None


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'gpusense' has no attribute 'BeamModle'"):
        gs.BeamModle  # noqa: B018
