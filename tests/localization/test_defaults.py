"""Library, commands and page share one table of defaults."""

from __future__ import annotations

import argparse
import copy
import importlib
import inspect
import re
from pathlib import Path

from support.bench_scripts import BENCH

import gpusense as gs
from gpusense.commands import arguments, landmarks, localize
from gpusense.localization.defaults import DEFAULTS


def shown(value):
    if value is None:
        return "all"
    if isinstance(value, tuple):
        return ", ".join(map(str, value))
    return ", ".join(f"{k} {v}" for k, v in value.items()) if hasattr(value, "items") else str(value)


def test_the_page_has_the_table():
    page = (Path(__file__).parents[2] / "docs" / "localization.md").read_text()
    rows = dict(re.findall(r"^\| (\w+) \| (.*?) \| .* \|$", page[page.index("## Defaults") :], re.M))
    rows.pop("name")
    assert rows == {name: shown(value) for name, value in DEFAULTS._asdict().items()}


def test_class_commands_sweeps_and_bench_have_one_field(monkeypatch):
    """``test_sweeps.py`` compares a sweep with the class, ``test_localize_command.py`` the filter with ``localize``."""
    grid, scanner, tracking = (
        gs.OccupancyGrid([[0, 100]]),
        gs.Scanner([0.0], 1.0),
        gs.LikelihoodFieldParameters.tracking(),
    )
    model = gs.LikelihoodFieldModel(grid, scanner, backend="numpy")
    assert model.parameters == copy.copy(model).parameters == tracking != gs.LikelihoodFieldParameters()
    monkeypatch.syspath_prepend(BENCH)
    assert importlib.import_module("recordings").field("numpy")(grid, scanner).parameters == tracking
    parser = argparse.ArgumentParser(add_help=False)
    arguments.SHARED["model"](arguments.Options(parser))
    assert arguments.parameters_of(parser.parse_args(["--model", "field"])) == tracking


def test_library_and_commands_have_its_values():
    options = inspect.signature(gs.ParticleFilter).parameters
    for name in ("particles", "threshold", "stages", "temperature"):
        assert options[name].default == getattr(DEFAULTS, name), name
    motion = gs.OdometryMotion()
    for name in ("alpha", "reverse", "least", "sideways"):
        assert getattr(motion, name) == getattr(DEFAULTS, name), name
    assert gs.OmniMotion().least == gs.VelocityMotion().least == DEFAULTS.least
    parsers = []
    for command in (localize, landmarks):
        parsers.append(argparse.ArgumentParser(add_help=False))
        command.add_options(arguments.Options(parsers[-1]))
    assert parsers[0].get_default("temperature") == DEFAULTS.temperature
    assert parsers[1].get_default("particles") == DEFAULTS.particles
    # Options that override a file of parameters have no default; their help states the table's value.
    text = re.sub(r"\s+", " ", parsers[0].format_help())
    alpha = shown(DEFAULTS.alpha).replace(",", "")
    for value in (f"default: {DEFAULTS.particles}", alpha, f"default: {DEFAULTS.reverse})"):
        assert value in text, value
