"""The rules that readers of all formats keep, and the lists of formats for users."""

from __future__ import annotations

import gzip

import pytest
from support.paths import ROOT
from support.text_logs import LOGS, each_text_format

import gpusense as gs
from gpusense.commands import scans as command_scans
from gpusense.logs.reader import FORMATS, format_of


@each_text_format
def test_scans_are_read_only_share_a_scanner_and_obey_limits(tmp_path, form):
    name, lines = LOGS[form.module]
    text = "\n".join(lines) + "\n"
    for path, data in ((tmp_path / name, text.encode()), (tmp_path / f"{name}.gz", gzip.compress(text.encode()))):
        path.write_bytes(data)
        assert format_of(path) is form
        for range_min in (None, 0.25):
            scans = list(gs.read_log(path, range_max=7.5, range_min=range_min))
            assert len(scans) == 6 and {id(scan.scanner) for scan in scans} == {id(scans[0].scanner)}
            assert (scans[0].scanner.range_max, scans[0].scanner.range_min) == (7.5, range_min or 0.0)
            assert not any(scan.ranges.flags.writeable for scan in scans)


@each_text_format
def test_a_log_without_records_is_an_error_that_names_it(tmp_path, form):
    path = tmp_path / LOGS[form.module][0]
    path.write_text("\n")
    with pytest.raises(ValueError) as caught:
        list(gs.read_log(path))
    assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize("form", FORMATS, ids=lambda form: form.name)
def test_lists_of_formats_name_each(form):
    name = form.name.split(maxsplit=1)[1].removesuffix(" log").removesuffix(" bag")
    page = (ROOT / "docs" / "logs.md").read_text(encoding="utf-8")
    assert f"\n| {name}" in page
    assert name in command_scans.FORMATS and name in str(gs.read_log.__doc__)
