"""Make small HTML tables for ``_repr_html_`` in notebooks, with escaped contents."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

FIT_HEAD = ("parameter", "value", "standard error", "")
"""Headings of the table of a fit."""
LONGEST = 2000
"""Most characters of a cell or detail; the rest is omitted."""


def card(
    title: str, rows: Iterable[Sequence[object]], *, head: Sequence[str] = (), detail: str = "", picture: bytes = b""
) -> str:
    """Return a table with a title, and perhaps a PNG next to it and text below it that opens on a click.

    Rows start with their headings; floats have five digits.
    """
    parts = [f"<b>{_text(title)}</b>"]
    if picture:
        import base64

        code = base64.b64encode(picture).decode("ascii")
        parts.append(f'<br><img alt="{_text(title)}" src="data:image/png;base64,{code}">')
    lines = [f"<tr>{''.join(f'<th>{_text(name)}</th>' for name in head)}</tr>"] if head else []
    for first, *others in rows:
        cells = "".join(f"<td>{_text(cell)}</td>" for cell in others)
        lines.append(f"<tr><th>{_text(first)}</th>{cells}</tr>")
    parts.append(f"<table>{''.join(lines)}</table>")
    if detail:
        parts.append(f"<details><summary>more</summary><pre>{_text(detail)}</pre></details>")
    return f"<div>{''.join(parts)}</div>"


def split_options(options: Iterable[str]) -> list[tuple[str, str]]:
    """Split options in the form of ``repr``, such as ``caster=Exact()``, into names and values."""
    pairs = []
    for option in options:
        name, equals, value = option.partition("=")
        pairs.append((name, value) if equals else ("", name))
    return pairs


def pose_rows(pose: NDArray[np.floating], covariance: NDArray[np.floating]) -> list[tuple[object, ...]]:
    """Return the rows of a pose with its standard deviations."""
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist()
    names = ("x [m]", "y [m]", "theta [rad]")
    return [(name, float(value), error) for name, value, error in zip(names, pose.tolist(), deviations, strict=True)]


def grey_png(pixels: NDArray[np.uint8]) -> bytes:
    """Return (H, W) grey values as a PNG."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG")
    return stream.getvalue()


def _text(value: object) -> str:
    import html

    text = f"{value:.5g}" if isinstance(value, float) else str(value)
    return html.escape(text if len(text) <= LONGEST else f"{text[:LONGEST]} ...")
