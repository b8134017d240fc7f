"""Configure the site; its source is the whole checkout: python -m sphinx -W -c docs . site"""

from __future__ import annotations

import gc
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "bench"))
from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from error_vs_time.page import interactive
from make_figures import write_pages as write_figures
from reference_pages import write_pages
from sphinx import addnodes

import gpusense

ROOT = Path(__file__).parents[1]

project = "gpusense"
author = "The gpusense developers"
copyright = author
version = release = gpusense.__version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_gallery.gen_gallery"]
root_doc = "docs/index"
include_patterns = [
    "docs/**.md", "docs/**.rst", "bench/RESULTS.md", "bench/results/*.md", "CHANGELOG.md", "CODE_OF_CONDUCT.md",
    "CONTRIBUTING.md", "README.md", "SECURITY.md",
    "examples/notebooks/*.ipynb",
]  # fmt: skip
exclude_patterns = ["**/.*", "site", "docs/tour/GALLERY_HEADER.rst"]
# Reports begin with the heading that they have in a page.
suppress_warnings = ["myst.header", "config.cache"]

myst_heading_anchors = 4
# Formulas between dollar signs become MathML, which browsers typeset without a script.
myst_enable_extensions = ["dollarmath"]
html_math_renderer = "mathml"
# Notebooks have no outputs in the checkout; each runs here, in a separate folder.
nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 120
nb_execution_show_tb = True
nb_merge_streams = True
autodoc_member_order = "bysource"
autodoc_typehints = "none"
autodoc_inherit_docstrings = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_attr_annotations = False

sphinx_gallery_conf = {
    "examples_dirs": [str(ROOT / "docs" / "tour")],
    "gallery_dirs": ["docs/lectures"],
    "within_subsection_order": "FileNameSortKey",
    "filename_pattern": r"/\d\d_",
    "remove_config_comments": True,
    "min_reported_time": 3600,
    "show_memory": False,
    "show_signature": False,
    "download_all_examples": False,
    "thumbnail_size": (600, 420),
    "abort_on_example_error": True,
    "write_computation_times": False,
}

html_theme = "furo"
html_title = f"gpusense {version}"
html_extra_path = ["front"]
html_static_path = ["static"]
html_css_files = ["site.css"]
html_copy_source = False


def mark_reports(app: Any, name: str, source: list[str]) -> None:
    """Mark reports and notes as orphans: pages link to them, tables of contents do not list them."""
    if name.startswith(("bench/results/", "docs/notes/")):
        source[0] = f"---\norphan: true\n---\n{source[0]}"


# A character for private use, in place of the colons of an attribute's text while napoleon reads it.
COLON = "\ue000"


def hide_colons(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Replace colons in the first line of an attribute's text: napoleon reads words before a colon as a type."""
    if what in ("attribute", "property") and lines:
        lines[0] = lines[0].replace(": ", f"{COLON} ")


def show_colons(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Put hidden colons back."""
    lines[:] = [line.replace(COLON, ":") for line in lines]


# Files of the checkout that the site shows as a page: links to them work in both.
SHOWN = {"01_four_causes.py": "docs/lectures/index.html", "__init__.pyi": "docs/api/index.html"}


def open_figures(app: Any, doctree: nodes.document) -> None:
    """Let links to files of ``docs/front`` and to ``SHOWN`` open pages of the site instead of downloads."""
    root = "../" * app.env.docname.count("/")
    for node in list(doctree.findall(addnodes.download_reference)):
        path = node["reftarget"].partition("front/")[2]
        path = SHOWN.get(Path(node["reftarget"]).name, path)
        if path:
            node.replace_self(nodes.reference("", "", *node.children, refuri=f"{root}{path}"))


def write_formula(translator: Any, node: nodes.Element, block: bool) -> None:
    """Write a formula as MathML."""
    translator.body.append(tex2mathml(node.astext(), as_block=block))
    raise nodes.SkipNode


def setup(app: Any) -> None:
    """Write the pages of the public names and the figures that move before Sphinx looks for pages."""
    write_pages(ROOT / "docs" / "api")
    figures = ROOT / "docs" / "front" / "figures"
    write_figures(figures)
    (figures / "error-vs-time.html").write_text(interactive(), encoding="utf-8")
    app.add_html_math_renderer(
        "mathml",
        (lambda translator, node: write_formula(translator, node, False), None),
        (lambda translator, node: write_formula(translator, node, True), None),
    )
    app.connect("source-read", mark_reports)
    # Before and after napoleon reads docstrings.
    app.connect("autodoc-process-docstring", hide_colons, priority=100)
    app.connect("autodoc-process-docstring", show_colons, priority=900)
    # Before Sphinx collects the files to be downloaded.
    app.connect("doctree-read", open_figures, priority=100)
    # Devices' memory of the tour's programs is freed before the interpreter ends.
    app.connect("build-finished", lambda *_: gc.collect())
