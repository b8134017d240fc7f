"""Draw error against time as SVG, with the same bytes everywhere."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

# Okabe and Ito's palette, which remains distinct under colour blindness.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#7f4f24", "#5e3c99", "#7a7a7a",
           "#66a61e", "#e7298a", "#8b0000", "#1b7f79")  # fmt: skip
WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 480, 330, 62, 14, 34, 48
STRIP = 62
"""Width of the strip for methods without an error."""
SMALLEST = 1e-6
LABELS = 4
"""Largest number of labels of a panel; the other names are shown on hover."""
# Corners of the shapes of groups; none is a circle.
SHAPES: tuple[tuple[tuple[float, float], ...], ...] = (
    (), ((-0.8, -0.8), (0.8, -0.8), (0.8, 0.8), (-0.8, 0.8)), ((0, -1), (1, 0.8), (-1, 0.8)),
    ((0, -1), (1, 0), (0, 1), (-1, 0)), ((0, 1), (1, -0.8), (-1, -0.8)),
)  # fmt: skip


@dataclass(frozen=True)
class Mark:
    """A point of a chart.

    Attributes:
        error, seconds: Its coordinates; an error below ``SMALLEST`` counts as none.
        group: Group, which has a colour.
        best: Whether it belongs to the Pareto front, and has a label.
    """

    error: float
    seconds: float
    name: str
    group: str
    best: bool = False


@dataclass(frozen=True)
class Chart:
    """One panel: a title, the label of the errors, and marks."""

    title: str
    axis: str
    marks: Sequence[Mark]


def drawing(charts: Sequence[Chart]) -> str:
    """Draw panels side by side, two in a row, above the legend of their groups."""
    groups = list(dict.fromkeys(mark.group for chart in charts for mark in chart.marks))
    rows, columns = -(-len(charts) // 2), min(len(charts), 2)
    width, legend = WIDTH * columns, -(-len(groups) // (3 * columns))
    height = HEIGHT * rows + 18 * legend + 8
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif" '
        f'font-size="11">',
        "<style>.n{font-size:10px;paint-order:stroke;stroke:white;stroke-width:3px}.g{stroke:#e3e7ed}.f{fill:none;stroke:#b8c0cc;stroke-width:4;stroke-opacity:.8}.t{font-weight:bold}"
        ".s{fill:#4a5568}</style>",
        f'<rect width="{width}" height="{height}" fill="white"/>',
    ]
    scales = _scales(charts)
    for i, chart in enumerate(charts):
        parts.append(f'<g transform="translate({WIDTH * (i % 2)} {HEIGHT * (i // 2)})">')
        parts += _panel(chart, groups, scales)
        parts.append("</g>")
    for i, group in enumerate(groups):
        x, y = 20 + 160 * (i % (3 * columns)), HEIGHT * rows + 14 + 18 * (i // (3 * columns))
        parts.append(_symbol(groups, group, x, y - 4, 4, ""))
        parts.append(f'<text x="{x + 9}" y="{y}">{escape(group)}</text>')
    return "\n".join([*parts, "</svg>", ""])


def _colour(groups: Sequence[str], group: str) -> str:
    return COLOURS[groups.index(group) % len(COLOURS)]


def _symbol(groups: Sequence[str], group: str, x: float, y: float, radius: float, title: str) -> str:
    """Draw the symbol of a group: its colour, and its shape."""
    corners = SHAPES[groups.index(group) % len(SHAPES)]
    inside = f"<title>{escape(title)}</title>" if title else ""
    colour = f'fill="{_colour(groups, group)}"'
    if not corners:
        return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius}" {colour}>{inside}</circle>'
    points = " ".join(f"{x + 1.25 * radius * a:.1f},{y + 1.25 * radius * b:.1f}" for a, b in corners)
    return f'<polygon points="{points}" {colour}>{inside}</polygon>'


def _scales(charts: Sequence[Chart]) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the decades of errors and of times that all panels share."""
    errors = [mark.error for chart in charts for mark in chart.marks if mark.error >= SMALLEST]
    return _decades(errors or [0.1]), _decades([mark.seconds for chart in charts for mark in chart.marks])


def _panel(chart: Chart, groups: Sequence[str], scales: tuple[tuple[int, int], tuple[int, int]]) -> list[str]:
    (low, high), (fast, slow) = scales
    begin, end, top, bottom = LEFT + STRIP, WIDTH - RIGHT, TOP, HEIGHT - BOTTOM

    def x(error: float) -> float:
        if error < SMALLEST:
            return LEFT + STRIP / 2
        return begin + (math.log10(error) - low) / (high - low) * (end - begin)

    def y(seconds: float) -> float:
        return bottom - (math.log10(seconds) - fast) / (slow - fast) * (bottom - top)

    parts = [
        f'<text x="{LEFT}" y="18" class="t">{escape(chart.title)}</text>',
        f'<rect x="{LEFT}" y="{top}" width="{STRIP}" height="{bottom - top}" fill="#eef1f5"/>',
        f'<text x="{LEFT + STRIP / 2 - 10:.0f}" y="{bottom + 14}" text-anchor="middle" class="s">exact</text>',
        f'<text x="{(begin + end) / 2:.0f}" y="{HEIGHT - 10}" text-anchor="middle">{escape(chart.axis)}</text>',
        f'<text x="14" y="{(top + bottom) / 2:.0f}" text-anchor="middle" '
        f'transform="rotate(-90 14 {(top + bottom) / 2:.0f})">time</text>',
    ]
    for decade in range(low, high + 1):
        at = x(10.0**decade)
        parts.append(f'<path class="g" d="M{at:.1f} {top}V{bottom}"/>')
        parts.append(f'<text x="{at:.1f}" y="{bottom + 14}" text-anchor="middle" class="s">{10.0**decade:g}</text>')
    for decade in range(fast, slow + 1):
        at = y(10.0**decade)
        parts.append(f'<path class="g" d="M{LEFT} {at:.1f}H{end}"/>')
        parts.append(f'<text x="{LEFT - 5}" y="{at + 4:.1f}" text-anchor="end" class="s">{_time(decade)}</text>')
    best = sorted((mark for mark in chart.marks if mark.best), key=lambda mark: (x(mark.error), -mark.seconds))
    if best:
        steps = "".join(f"H{x(mark.error):.1f}V{y(mark.seconds):.1f}" for mark in best[1:])
        parts.append(f'<path class="f" d="M{x(best[0].error):.1f} {y(best[0].seconds):.1f}{steps}H{end}"/>')
    for mark in sorted(chart.marks, key=lambda mark: mark.best):
        parts.append(_symbol(groups, mark.group, x(mark.error), y(mark.seconds), 4.5 if mark.best else 3, mark.name))
    return parts + _names(best, x, y)


def _names(best: Sequence[Mark], x, y) -> list[str]:
    """Label at most four marks of the front below and left of it, where no mark is; skip labels that would overlap."""
    last = len(best) - 1
    best = [best[k] for k in sorted({round(last * k / (LABELS - 1)) for k in range(LABELS)})] if best else []
    placed: list[tuple[float, float, float]] = []
    parts = []
    for mark in best:
        width = 5.6 * len(mark.name)
        right = max(x(mark.error) - 7, LEFT + 4 + width)
        left, at = right - width, y(mark.seconds) + 13
        if any(abs(at - other) < 12 and left < till and begin < right for begin, till, other in placed):
            continue
        placed.append((left, right, at))
        parts.append(f'<text x="{right:.1f}" y="{at:.1f}" text-anchor="end" class="n">{escape(mark.name)}</text>')
    return parts


def _decades(numbers: Sequence[float]) -> tuple[int, int]:
    """Return the decades that enclose positive numbers."""
    low, high = math.floor(math.log10(min(numbers))), math.ceil(math.log10(max(numbers)))
    return low, max(high, low + 1)


def _time(decade: int) -> str:
    value = 10.0**decade
    for unit, scale in (("ns", 1e9), ("us", 1e6), ("ms", 1e3)):
        if value * scale < 999:
            return f"{value * scale:g} {unit}"
    return f"{value:g} s"
