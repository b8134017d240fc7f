"""The first hour with the command line: defaults, narrow terminals, interrupts, and rows as they come."""

from __future__ import annotations

import json
import re
import sys

import numpy as np
import pytest
from support.command_line import error_of
from support.room_log import write_building

import gpusense as gs
from gpusense.commands import output
from gpusense.commands.cli import main
from gpusense.evaluation import scoring
from gpusense.learning.beam import fit as learning


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Write a map of a building, a log of five scans in it, and a file of pairs; return options of ``score``."""
    folder = tmp_path_factory.mktemp("recorded")
    write_building(folder, 5, 31)
    z = np.abs(np.random.default_rng(4).normal(4, 0.1, 300))
    (folder / "pairs.csv").write_text("\n".join(f"{each:.4f},4.0" for each in z) + "\n")
    return folder


def score(folder, *options):
    log = ["--map", str(folder / "map.yaml"), "--log", str(folder / "run.log")]
    return ["score", *log, "--backend", "numpy", "--particles", "50", *options]


def test_no_beams_are_an_error(capsys, recorded):
    assert error_of(score(recorded, "--beams", "0"), capsys) == "argument --beams: must be an integer >= 1, got 0"


@pytest.mark.parametrize(
    "model, parameters", [("beam", gs.BeamParameters()), ("field", gs.LikelihoodFieldParameters.tracking())]
)
def test_commands_have_the_defaults_of_the_library(capsys, recorded, model, parameters):
    assert main(score(recorded, "--model", model, "--limit", "1", "--json")) == 0
    assert json.loads(capsys.readouterr().out)["parameters"] == parameters.to_dict()


def interrupt_at(monkeypatch, index):
    """Press Ctrl-C while a scan is scored."""
    add = scoring.LogScoring.add

    def interrupted(self, number, scan):
        if number == index:
            raise KeyboardInterrupt
        return add(self, number, scan)

    monkeypatch.setattr(scoring.LogScoring, "add", interrupted)


def test_an_interrupted_score_prints_its_results_so_far(capsys, recorded, monkeypatch):
    interrupt_at(monkeypatch, 3)
    assert main(score(recorded)) == 130
    out, err = capsys.readouterr()
    assert err == "gpusense: interrupted\n"
    assert "interrupted: results of 3 of 5 scans" in out and "3 scans, 50 particles each" in " ".join(out.split())
    assert "model      beam, on numpy" in out
    assert main(score(recorded, "--json")) == 130
    document = json.loads(capsys.readouterr().out)
    assert [scan["index"] for scan in document["scans"]] == [0, 1, 2] and document["scans_chosen"] == 5


def test_a_score_interrupted_before_its_first_scan_prints_nothing(capsys, recorded, monkeypatch):
    interrupt_at(monkeypatch, 0)
    assert main(score(recorded)) == 130
    assert capsys.readouterr().out == ""


def fit(folder, *options):
    return ["fit", "--pairs", str(folder / "pairs.csv"), "--range-max", "10", "--backend", "numpy", *options]


def test_an_interrupted_fit_prints_the_best_parameters_so_far(capsys, recorded, monkeypatch):
    see = learning.climb_em

    def interrupted(*args, watch, **settings):
        def stop(iteration, value):
            watch(iteration, value)
            if iteration == 1:
                raise KeyboardInterrupt

        return see(*args, watch=stop, **settings)

    monkeypatch.setattr(learning, "climb_em", interrupted)
    assert main(fit(recorded)) == 130
    out, err = capsys.readouterr()
    assert err == "gpusense: interrupted\n"
    assert "before convergence" in out and "sigma_hit" in out and "log-likelihood" in out
    assert main(fit(recorded, "--json")) == 130
    document = json.loads(capsys.readouterr().out)
    assert document["interrupted"] and 0.05 < document["parameters"]["sigma_hit"] < 0.5


def test_a_fit_interrupted_after_its_search_prints_it(capsys, recorded, monkeypatch):

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("gpusense.evaluation.range_data.compare_held_out", interrupted)
    assert main(fit(recorded, "--holdout")) == 130
    assert "this fit had ended" in capsys.readouterr().out


def test_help_names_the_columns_of_pairs_and_their_delimiter(capsys):
    assert main(["fit", "--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "columns separated by commas" in text and "reading [m], expected range [m]" in text


def narrow(monkeypatch, width):
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)


def test_a_table_does_not_fold_on_a_narrow_terminal(capsys, monkeypatch):
    names = ("selection", "kind", "name", "driver", "status")
    rows = [("opencl:0:0", "cpu", "an accelerator with a long name", "PoCL 3.0, 16 lanes", "available"), ("", *"abcd")]
    narrow(monkeypatch, 60)
    output.table(names, rows)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "selection  opencl:0:0" and lines[2] == "name       an accelerator with a long name"
    assert lines[5:7] == ["", "kind       a"]
    narrow(monkeypatch, 160)
    output.table(names, rows)
    wide = capsys.readouterr().out.splitlines()
    assert any("selection" in line and "driver" in line for line in wide) and len(wide) < len(lines)


@pytest.mark.parametrize("width", range(26, 36))
def test_no_width_folds_a_table(capsys, monkeypatch, width):
    narrow(monkeypatch, width)
    output.table(("name", "error [m]", "time"), [("a longer name", "0.25", "1.5 ms")])
    lines = [line.rstrip() for line in re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out).splitlines()]
    lines = [line for line in lines if line]
    table = lines[0].split() == ["name", "error", "[m]", "time"]
    assert table == (width >= 32)
    assert table or lines == ["name       a longer name", "error [m]  0.25", "time       1.5 ms"]
