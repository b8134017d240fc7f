"""Report what scaling.py measured: its table, the probes' figures, and the diagram."""

from __future__ import annotations

from pathlib import Path
from typing import Any

# scaling.py has made bench/ importable.
from common import table

KINDS = ("rays", "beam model", "field")
AXES = {"particles": "particles", "beams": "beams", "side": "side of the map [cells]"}
COLUMNS = (
    "backend", "what", "particles x beams", "map", "ms a call (median)", "ms, launches alone", "floor of both, ms",
    "set by", "M/s, call", "M/s, launches", "share of the floor's rate", "max error",
)  # fmt: skip


def cells(r: dict[str, Any]) -> list[str]:
    """Format the cells of a row, with a mark at times below the floor."""
    work = r["particles"] * r["beams"] / 1e6
    share = r["floor_launch_s"] / r["launch_s"]
    return [
        r["backend"], r["what"], f"{r['particles']} x {r['beams']}", f"{r['side']} x {r['side']}",
        f"{r['call_s'] * 1e3:.4g} ({r['median_s'] * 1e3:.4g})", f"{r['launch_s'] * 1e3:.4g}",
        f"{r['floor_call_s'] * 1e3:.3g}, {r['floor_launch_s'] * 1e3:.3g}", r["cause"], f"{work / r['call_s']:.4g}",
        f"{work / r['launch_s']:.4g}", f"{share:.0%}{' (below the floor)' if share > 1 else ''}", f"{r['error']:.1e}",
    ]  # fmt: skip


def figures_markdown(device: dict[str, Any]) -> str:
    """Format the probes' figures, the table, and the points that were left out."""
    f = device["figures"]
    sizes = ", ".join(f"{size >> 10} KiB {value / 1e9:.3g} G/s" for size, value in f["scattered"].items())
    copies = ", ".join(f"{size >> 20} MiB {value / 1e9:.4g} GB/s" for size, value in f["copy"].items())
    lines = [
        f"## {device['device']}, {device['backend']}", "",
        f"Floor of {f['source']}: launch {f['launch_s'] * 1e6:.3g} us, round trip {f['round_trip_s'] * 1e6:.3g} us; "
        f"additions {f['issue'] / 1e9:.4g} G/s; look-ups nearest {f['together'] / 1e9:.4g} G/s, at random in {sizes}; "
        f"copies of {copies}; upload {f['upload'] / 1e9:.3g} GB/s, download {f['download'] / 1e9:.3g} GB/s.", "",
        table(COLUMNS, map(cells, device["rows"])), "",
        f"Left out: {len(device['left_out'])} points." if device["left_out"] else "No point was left out.",
        *(f"- {line}" for line in device["left_out"] + f["left_out"]), "",
    ]  # fmt: skip
    return "\n".join(lines)


def draw(device: dict[str, Any], path: Path) -> None:
    """Draw three panels: nanoseconds per ray or particle-beam over particles, beams and the map's side."""
    from gpusense.plots.drawing import new_figure

    colours = dict(zip(KINDS, ("#0072b2", "#d55e00", "#009e73"), strict=True))
    figure = new_figure(15.0, 5.6)
    for ax, axis in zip(figure.subplots(1, 3, sharey=True), AXES, strict=True):
        for kind in KINDS:
            rows = [row for row in device["rows"] if row["axis"] == axis and row["what"] == kind]
            if not rows:
                continue
            x = [row["value"] for row in rows]
            y = {
                name: [1e9 * row[name] / (row["particles"] * row["beams"]) for row in rows]
                for name in ("call_s", "launch_s", "floor_launch_s", "floor_call_s", "scattered_s")
            }
            ax.plot(x, y["call_s"], "-o", color=colours[kind], ms=4, lw=1.3)
            ax.plot(x, y["launch_s"], "--s", color=colours[kind], ms=4, lw=1.1, mfc="none")
            ax.plot(x, y["floor_launch_s"], ":", color=colours[kind], lw=1.6)
            ax.plot(x, y["floor_call_s"], "-.", color=colours[kind], lw=0.8)
            ax.fill_between(x, y["floor_launch_s"], y["scattered_s"], color=colours[kind], alpha=0.12, lw=0)
        fixed = [row for row in device["rows"] if row["axis"] == axis][:1]
        caption = {
            "particles": "{beams} beams, map of {side} cells",
            "beams": "{particles} particles, map of {side} cells",
            "side": "{particles} particles, {beams} beams",
        }[axis]
        ax.set(xlabel=AXES[axis])
        if fixed:
            ax.set(xscale="log", yscale="log")
        ax.set_title(caption.format(**fixed[0]) if fixed else "every point left out", loc="left", fontsize="medium")
        ax.grid(True, which="major", color="#e3e7ed", lw=0.6)
    figure.axes[0].set_ylabel("time per ray or particle-beam [ns]")
    _legend(figure, colours)
    figure.suptitle(f"{device['device']}, {device['backend']}", x=0.01, ha="left", fontsize="medium")
    figure.savefig(path)


def _legend(figure: Any, colours: dict[str, str]) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    grey = "#4a5568"
    handles: list[Any] = [Line2D([], [], color=colour, lw=2, label=kind) for kind, colour in colours.items()]
    handles += [
        Line2D([], [], color=grey, ls="-", marker="o", ms=4, label="call, NumPy in and out"),
        Line2D([], [], color=grey, ls="--", marker="s", ms=4, mfc="none", label="launches alone"),
        Line2D([], [], color=grey, ls=":", lw=1.6, label="floor of launches"),
        Line2D([], [], color=grey, ls="-.", lw=0.8, label="floor of a call"),
        Patch(color=grey, alpha=0.15, label="to look-ups at random"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=8, fontsize="small", frameon=False)
