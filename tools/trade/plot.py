"""The plot of every setting's cost against its event error."""

from __future__ import annotations

import io
import json
import math

import numpy as np

from blinkgl.report.charts import data_uri, number, render
from blinkgl.tools.trade.words import NAMES, convergence_line

COLOURS = {
    "none": "#d9552f",
    "taps4": "#8a5fc0",
    "edges": "#b0307a",
    "edges2": "#6b4a2b",
    "ssaa2": "#3d6bd6",
    "ssaa4": "#2a9d8f",
    "ssaa8": "#8a7a2a",
}
COSTS = {"wall_s": "seconds of computing per simulated second", "cpu_s": "processor seconds per simulated second"}
PANELS = (
    ("voxel", "", 100.0, "%"),
    ("wrong", "missed + invented events", 100.0, "%"),
    ("shift_median_px", "typical displacement of an event's edge", 1.0, "px"),
)


def pareto(result: dict) -> bytes:
    """Return the plot as PNG bytes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 8.6), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 3)
    axes = [figure.add_subplot(grid[:, :2]), figure.add_subplot(grid[0, 2]), figure.add_subplot(grid[1, 2])]
    rows = [r for r in result["settings"] if (r["size"] or "full") == result["size"]]
    cost = result["cost"]
    for ax, (key, title, factor, unit) in zip(axes, PANELS):
        _panel(ax, rows, cost, key, factor, unit, large=ax is axes[0])
        ax.set_title(title, fontsize=11)
    size = result["sizes"][result["size"]]
    figure.suptitle(
        "Speed against accuracy: left is cheaper, down is better; no setting is below and left of "
        f"the line\n{size['width']}x{size['height']} px, {size['clip_s']:g} s simulated",
        fontsize=12.5,
    )
    axes[0].set_ylabel("error of the events: difference of the voxel grids a network sees, relative")
    _legend(axes[0], rows)
    canvas.draw()
    # Until the names, whose length on the axis is not known in advance, fit beside their points.
    for _ in range(8):
        names = _label(axes[0], [r for r in rows if r["on_front"]], cost, canvas.get_renderer())
        if all(name.get_window_extent(canvas.get_renderer()).x0 > axes[0].bbox.x0 + 5 for name in names):
            break
        for name in names:
            name.remove()
        low, high = axes[0].get_xlim()
        axes[0].set_xlim(low * (low / high) ** 0.1, high)
        canvas.draw()
    else:
        _label(axes[0], [r for r in rows if r["on_front"]], cost, canvas.get_renderer())
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=100, metadata={"Software": None})
    return out.getvalue()


def _panel(ax, rows: list[dict], cost: str, key: str, factor: float, unit: str, large: bool) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for r in rows:
        if not (math.isfinite(r[key]) and r[key] > 0):
            continue
        best = r["on_front"]
        ax.plot(
            r[cost],
            r[key] * factor,
            "o",
            color=COLOURS.get(r["antialiasing"], "0.5"),
            ms=(11 if best else 7) * (1 if large else 0.7),
            mec="black" if best else "white",
            mew=1.4 if best else 0.6,
            alpha=1 if best else 0.6,
            zorder=4 if best else 3,
        )
    best = sorted((r for r in rows if r["on_front"]), key=lambda r: r[cost])
    if large:
        ax.step([r[cost] for r in best], [r[key] * factor for r in best], where="post", color="0.25", lw=1.2, zorder=2)
    ax.set(xscale="log", yscale="log", xlabel=COSTS[cost] + (" (log scale)" if large else ""))
    for axis, text in ((ax.xaxis, lambda v, _: f"{v:g}"), (ax.yaxis, lambda v, _: f"{v:g} {unit}")):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(FuncFormatter(text))
        axis.set_minor_formatter(NullFormatter())
    ax.grid(alpha=0.25)
    ax.spines[["top", "right"]].set_visible(False)
    if large:  # room for the names, below and left of the line
        low, high = ax.get_xlim()
        ax.set_xlim(low * (low / high) ** 0.28, high)
        low, high = ax.get_ylim()
        ax.set_ylim(low * (low / high) ** 0.12, high * (high / low) ** 0.3)  # and for the legend


def _legend(ax, rows: list[dict]) -> None:
    from matplotlib.lines import Line2D

    used = {r["antialiasing"] for r in rows}
    handles = [
        Line2D([], [], marker="o", ls="", color=c, label=f"anti-aliasing: {n}") for n, c in COLOURS.items() if n in used
    ]
    handles.append(
        Line2D(
            [],
            [],
            marker="o",
            ls="-",
            color="0.25",
            mfc="white",
            mec="black",
            mew=1.4,
            ms=10,
            label="not beaten by any other setting",
        )
    )
    ax.legend(handles=handles, loc="upper right", fontsize=10, framealpha=0.9, ncols=2)


def _label(ax, rows: list[dict], cost: str, renderer) -> list:
    """Add the names of the front's settings below and left of their points, where there are no others; move them down
    until they do not overlap."""
    factor, floor = PANELS[0][2], np.inf
    height, names = None, []
    for r in sorted(rows, key=lambda r: r[cost]):
        x, y = ax.transData.transform((r[cost], r["voxel"] * factor))
        at = min(y - 14, floor)
        text = ax.annotate(
            r["name"],
            (r[cost], r["voxel"] * factor),
            xytext=(x - 14, at),
            textcoords="figure pixels",
            ha="right",
            va="center",
            fontsize=9.5,
            arrowprops={"arrowstyle": "-", "color": "0.6", "lw": 0.7, "shrinkA": 1, "shrinkB": 6},
            zorder=5,
            bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.75},
        )
        height = height or text.get_window_extent(renderer).height
        floor = at - height - 3
        names.append(text)
    return names


# ---------------------------------------------------------------------------------------------------------------------
# The page: one self-contained HTML file in the style of the data-set report.


def page(result: dict, picture: bytes) -> str:
    """Return the HTML text. picture : the PNG of the plot."""
    size = result["sizes"][result["size"]]
    trust = []
    for name, judged in result["sizes"].items():
        line = convergence_line(result, name)
        trust.append((("" if name == "full" else f"{name}: ") + line[0].upper() + line[1:] + ".", judged["converged"]))
    tiles = [
        (len(result["settings"]), "settings measured"),
        (len(result["front"]), "worth choosing"),
        (f"{size['width']}×{size['height']}", "image"),
        (f"{size['clip_s']:g} s", "simulated clip"),
        (number(size["judged_pixels"]), "pixels judged"),
        (result["rounds"], "rounds"),
    ]
    thresholds = ", ".join(
        f"{k} {v:g}"
        for k, v in size["emulator"].items()
        if isinstance(v, float) and k.startswith(("contrast", "threshold_sigma"))
    )
    return render(
        "tools.trade/trade.html",
        title="Cost of accuracy",
        result=result,
        settings=result["settings"],
        tiles=tiles,
        trust=trust,
        measures=NAMES,
        picture=data_uri(picture),
        emulator=size["emulator"],
        thresholds=thresholds,
        configuration=json.dumps(result["config"], indent=1, default=str),
    )
