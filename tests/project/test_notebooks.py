"""Notebooks hold no outputs and fetch nothing; the build of the site executes them."""

from __future__ import annotations

import json
import re

import pytest
from support.paths import ROOT

NOTEBOOKS = sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))


def cells(notebook, kind):
    """Return the sources of a notebook's cells of a kind."""
    data = json.loads(notebook.read_text(encoding="utf-8"))
    return ["".join(cell["source"]) for cell in data["cells"] if cell["cell_type"] == kind]


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_source_alone(notebook):
    data = json.loads(notebook.read_text(encoding="utf-8"))
    ran = [cell for cell in data["cells"] if cell.get("outputs") or cell.get("execution_count")]
    assert not ran and len(data["cells"]) > 8, "clear the outputs"
    assert not re.search(r"https?:|\bpip\b|^!|^%", "\n".join(cells(notebook, "code")), re.MULTILINE)


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_says_its_idea_and_checks_its_result(notebook):
    words = cells(notebook, "markdown")
    assert words[0].startswith("# ") and "**Try:**" in words[-1]
    assert "assert" in "\n".join(cells(notebook, "code"))


def test_the_site_executes_each_notebook():
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\.\./(examples/notebooks/\S+)$", index, re.MULTILINE)
    assert sorted(listed) == [path.relative_to(ROOT).with_suffix("").as_posix() for path in NOTEBOOKS]
    settings = (ROOT / "docs" / "conf.py").read_text(encoding="utf-8")
    assert 'nb_execution_mode = "force"' in settings and "nb_execution_raise_on_error = True" in settings


def test_tensors_of_pytorch_go_in_and_out(tmp_path, monkeypatch):
    """Without PyTorch the site's build runs the same cells with NumPy."""
    pytest.importorskip("torch")
    plt = pytest.importorskip("matplotlib.pyplot")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(plt, "show", plt.close)
    names = {}
    for cell in cells(ROOT / "examples" / "notebooks" / "pytorch_and_gradients.ipynb", "code"):
        exec(cell, names)
    assert type(names["log_p"]).__module__ == "numpy" and names["torch"].is_tensor(names["weights"])
