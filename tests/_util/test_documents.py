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


@pytest.mark.parametrize(
    "text, line, first",
    [
        ("a: 1\nb: 2\na: 3\n", 3, 1), ("x:\n  - {a: 1, 'a': 1}\n", 2, 2),
        ("16: 1\n0x10: 2\n", 2, 1), ("{a: 1, a: 1}", 1, 1),
        ("true: 1\nyes: 2\n", 2, 1), ("base: &b {a: 1, a: 2}\nother: {<<: *b}\n", 1, 1),
        ("? [x]\n: {a: 1, a: 2}", 2, 2),
    ],
)  # fmt: skip
def test_doubled_keys_are_refused(tmp_path, text, line, first):
    (tmp_path / "doubled.yaml").write_text(text)
    match = (
        rf"doubled\.yaml: must be plain YAML, got an error in line {line}: the key .* is doubled, first in line {first}"
    )
    with pytest.raises(ValueError, match=match):
        read_mapping(tmp_path / "doubled.yaml")


def test_merged_and_inner_keys_may_be_the_same(tmp_path):
    (tmp_path / "merged.yaml").write_text(
        "b: &b {a: 1, c: {a: 2}}\nd: &d {<<: *b, a: 3}\ne: {<<: [*d, *b], c: 4}\nf: *b\n"
    )
    assert read_mapping(tmp_path / "merged.yaml") == yaml.safe_load((tmp_path / "merged.yaml").read_text())


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_byte_order_marks(tmp_path, encoding):
    (tmp_path / "mark.yaml").write_text("a: 1\n", encoding=encoding)
    assert read_mapping(tmp_path / "mark.yaml") == {"a": 1}
