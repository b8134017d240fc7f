"""Write the API reference from the table of public names: a page for each room of the package."""

from __future__ import annotations

import importlib
import inspect
from pathlib import Path

import gpusense

# Titles of the rooms, in the order of the pages; a room without a title comes last, under its own name.
TITLES = {
    "world": "Maps, scanners and parameters",
    "models": "Measurement models",
    "tables": "Tables of a map",
    "learning": "Learning",
    "matching": "Matching",
    "features": "Features of scans",
    "mapping": "Maps from scans",
    "chaining": "Chains of scans",
    "localization": "Localisation",
    "positions": "Positions from beacons",
    "logs": "Logs",
    "evaluation": "Judged trajectories",
    "backends": "Devices",
}
# The ten names that most programs use, with their meanings.
FIRST = {
    "read_map": "a map of map_server or slam_toolbox",
    "read_log": "scans and odometry of a bag or a CARMEN log",
    "OccupancyGrid": "a map from an array",
    "Scanner": "a laser or a ring of sonars",
    "BeamModel": "log p(z | x, m) by expected ranges",
    "LikelihoodFieldModel": "log p(z | x, m) by distances to obstacles",
    "ParticleFilter": "a pose with a verdict, scan by scan",
    "match_scan": "the motion between two scans, or a pose on a map",
    "build_map": "a map from scans with poses",
    "fit_beam_parameters": "the parameters of a sensor",
}
# Public modules, by their titles.
MODULES = {
    "casters": "Casters: gs.casters",
    "compat": "Weights and parameters of others: gs.compat",
    "plots": "Pictures: gs.plots",
    "sweep": "Sweeps: gs.sweep",
    "worlds": "Simulated worlds and runs: gs.worlds",
}


def rooms() -> dict[str, list[str]]:
    """Return the public names of each room, in the order of the pages."""
    found: dict[str, list[str]] = {room: [] for room in TITLES}
    for module, names in gpusense._NAMES.items():
        found.setdefault(module.split(".")[0], []).extend(names)
    return {room: sorted(names) for room, names in found.items() if names}


def entry(module: str, name: str) -> str:
    """Return the directive that documents a name."""
    value = getattr(importlib.import_module(module), name)
    path = f"{module}.{name}"
    if inspect.isclass(value):
        # Members of a dictionary, a tuple or an exception are those of Python.
        own = ":inherited-members: object, tuple, dict, Exception, BaseException, int, Enum, Executor\n   :members:"
        return f".. autoclass:: {path}\n   {own}\n"
    if callable(value):
        return f".. autofunction:: {path}\n"
    if isinstance(value, dict):
        shown = ", ".join(f"``{key!r}``" for key in value)
    elif isinstance(value, tuple):
        shown = ", ".join(f"``{getattr(one, '__name__', one)}``" for one in value)
    else:
        shown = f"``{value!r}``"
    return f".. py:data:: {path}\n\n   {type(value).__name__}: {shown}\n"


def page(title: str, module: str, names: list[str]) -> str:
    """Return a page in reStructuredText."""
    doc = (importlib.import_module(module).__doc__ or "").strip() if module != "gpusense" else ""
    head = f"{title}\n{'=' * len(title)}\n\n{doc}\n\n"
    return head + "\n".join(entry(module, name) for name in names)


def write_pages(folder: Path) -> None:
    """Write the pages into a folder; those that are as they were stay untouched, so that Sphinx does not read them."""
    pages = {room: page(TITLES.get(room, room.capitalize()), "gpusense", names) for room, names in rooms().items()}
    for module in gpusense._MODULES:
        names = sorted(importlib.import_module(f"gpusense.{module}").__all__)
        pages[module] = page(MODULES.get(module, f"gs.{module}"), f"gpusense.{module}", names)
    listed = "\n".join(f"   {name}" for name in pages)
    intro = "Begin with these ten; the pages below list every public name, with shapes, units, errors and an example."
    roles = {name: "class" if inspect.isclass(getattr(gpusense, name)) else "func" for name in FIRST}
    first = "\n".join(f"- :{roles[name]}:`gpusense.{name}`: {meaning}" for name, meaning in FIRST.items())
    pages["index"] = f"Reference\n=========\n\n{intro}\n\n{first}\n\n.. toctree::\n   :maxdepth: 2\n\n{listed}\n"
    folder.mkdir(exist_ok=True)
    for name, text in pages.items():
        file = folder / f"{name}.rst"
        if not file.is_file() or file.read_text(encoding="utf-8") != text:
            file.write_text(text, encoding="utf-8")
    for file in folder.glob("*.rst"):
        if file.stem not in pages:
            file.unlink()
