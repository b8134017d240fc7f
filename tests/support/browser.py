"""Headless Chromium and Node, for tests of interactive pages."""

from __future__ import annotations

import re
import shutil
import subprocess
from html import unescape
from pathlib import Path

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def in_browser(page: str, script: str, folder: Path) -> dict[str, str]:
    """Open a page, run a script at its end, and return the texts in ``document.body.dataset``."""
    if CHROMIUM is None:
        pytest.skip("Chromium is not installed")
    file = folder / "page.html"
    file.write_text(page.replace("</html>", f"<script>{script}</script></html>"), encoding="utf-8")
    command = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder / 'profile'}",
               "--dump-dom", file.as_uri()]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    found = re.findall(r'data-(\w+)="([^"]*)"', re.search(r"<body[^>]*>", done.stdout)[0])
    return {name: unescape(text) for name, text in found}


def in_node(source: str) -> str:
    """Return the output of a script."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("Node is not installed")
    return subprocess.run([node, "-"], input=source, capture_output=True, text=True, check=True).stdout
