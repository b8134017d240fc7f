"""YAML within bounds."""

from __future__ import annotations

import pytest
import yaml

from gpusense._util.documents import check_yaml, read_mapping


def test_both_limits_of_depth_give_the_same_error(monkeypatch, tmp_path):
    """Newer versions of libyaml end before the first event."""

    def parse(*_):
        raise yaml.parser.ParserError("while increasing flow level", None, "exceeded maximum nesting depth", None)

    file = tmp_path / "deep.yaml"
    file.write_text("x: " + "[" * 5000)
    with pytest.raises(ValueError, match="nested at most 100 deep") as own:
        read_mapping(file)
    monkeypatch.setattr(yaml, "parse", parse)
    with pytest.raises(ValueError, match="nested at most 100 deep") as parsers:
        read_mapping(file)
    assert str(own.value) == str(parsers.value)


def test_other_errors_of_the_parser_stay():
    with pytest.raises(yaml.YAMLError):
        check_yaml("a: [")
