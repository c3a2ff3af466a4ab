"""``blinkgl compare``: prints two recordings side by side as a table, and writes files if requested, one a plot of
rates over time, counts per pixel, intervals and correlations."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table

from blinkgl.io.atomic import atomic_file, output_errors, write_whole
from blinkgl.machine.terminal import plain_console, say
from blinkgl.recordings.comparison import BLUR_PX, IEI_EDGES_US, Comparison, RecordingSide, compare


def run(a: str, b: str | None, out: str | None = None, **options: Any) -> int:
    """``options``: of :func:`~blinkgl.recordings.comparison.compare`. With ``out`` also
    compare.json and compare.png in that folder."""
    result = compare(a, b, **options)
    console = plain_console()
    intervals = len(result.edges_us) - 1
    table = Table(
        title=f"{result.duration_s:.6g} s from {result.edges_us[0] / 1e6:.6f} s in {intervals} "
        f"interval{'s' * (intervals > 1)}; mean (min … max) over them; polarity sums blurred by {BLUR_PX:g} px",
        title_justify="left",
    )
    table.add_column("")
    table.add_column(f"A {Path(result.a.name).name}")
    if result.b:
        table.add_column(f"B {Path(result.b.name).name}")
    for quantity, first, second in result.rows():
        table.add_row(*((quantity, first, second) if result.b else (quantity, first)))
    console.print(table, highlight=False)
    for note in result.notes:
        say(console, note)
    if out is not None:
        write_whole(os.path.join(out, "compare.json"), json.dumps(result.to_dict(), indent=1) + "\n")
        plot(result, os.path.join(out, "compare.png"))
        say(console, f"written to {out}: compare.json, compare.png")
    return 0


if TYPE_CHECKING:
    from matplotlib.axes import Axes

_A, _B = "#1764ab", "#d1495b"
Side = tuple[RecordingSide, str, str]
"""A recording, its letter and its colour."""


def plot(result: Comparison, path: str | os.PathLike) -> None:
    """Draw one PNG of three to six panels. Raises OutputError when it cannot be written."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    sides = [(result.a, "A", _A)] + ([(result.b, "B", _B)] if result.b else [])
    top = max(1.0, *(float(np.percentile(s.counts, 99.5)) for s, _, _ in sides))
    panels: list[tuple[Any, ...]] = [
        (_rates, result, sides),
        *((_counts, side, top) for side in sides),
        (_intervals, sides),
    ]
    if result.a.frame_correlation is not None or result.polarity_correlation is not None:
        panels.append((_correlations, result, sides))
    if result.same_size:
        panels.append((_pixel_by_pixel, result, int(top) + 1))
    rows = -(-len(panels) // 3)
    figure = Figure(figsize=(13, 3.6 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle("   ".join(f"{tag}: {Path(s.name).name}, {s.count:,} events" for s, tag, _ in sides), fontsize=11)
    for number, (draw, *shown) in enumerate(panels):
        draw(figure.add_subplot(rows, 3, number + 1), *shown)
    with atomic_file(path) as temporary, output_errors(path):
        figure.savefig(temporary, dpi=110, metadata={"Software": None})


def _curves(ax: Axes) -> None:
    ax.spines[["top", "right"]].set_visible(False)
    ax.grid(alpha=0.25)
    ax.legend(frameon=False, fontsize=9)


def _rates(ax: Axes, result: Comparison, sides: list[Side]) -> None:
    # Seconds from the first interval on: a camera's clock may count from 1970.
    seconds = (result.edges_us - result.edges_us[0]) / 1e6
    for side, tag, colour in sides:
        rate = np.append(side.rate_hz, side.rate_hz[-1:]) / 1e6
        ax.step(seconds, rate, where="post", color=colour, label=tag)
    ax.set(title="event rate", xlabel="time [s]", ylabel="M events/s", ylim=(0, None))
    _curves(ax)


def _counts(ax: Axes, side: Side, top: float) -> None:
    image = ax.imshow(side[0].counts, cmap="magma", vmin=0, vmax=top)
    ax.set(title=f"{side[1]}: events per pixel", xticks=[], yticks=[])
    ax.figure.colorbar(image, ax=ax, shrink=0.7)


def _intervals(ax: Axes, sides: list[Side]) -> None:
    for side, tag, colour in sides:
        density = side.iei / max(side.iei.sum(), 1)
        ax.step(IEI_EDGES_US / 1000, np.append(density, density[-1:]), where="post", color=colour, label=tag)
    ax.set(title="interval between a pixel's events", xlabel="ms", ylabel="share per bin", xscale="log")
    ax.set_ylim(0, None)
    if len(used := np.flatnonzero(sum(s.iei for s, _, _ in sides))):
        ax.set_xlim(IEI_EDGES_US[used[0]] / 1000, IEI_EDGES_US[used[-1] + 1] / 1000)
    _curves(ax)


def _correlations(ax: Axes, result: Comparison, sides: list[Side]) -> None:
    middle = (result.edges_us[:-1] + result.edges_us[1:]) / 2e6 - result.edges_us[0] / 1e6
    for side, tag, colour in sides:
        if side.frame_correlation is not None:
            label = f"{tag} : frames, Δ ln(I+10)"
            ax.plot(middle, side.frame_correlation, "o-", ms=3, color=colour, label=label)
    if result.polarity_correlation is not None:
        ax.plot(middle, result.polarity_correlation, "s--", ms=3, color="0.35", label="A : B")
    ax.set(title="polarity sum per interval, correlation", xlabel="time [s]", ylim=(min(0, *ax.get_ylim()), 1))
    _curves(ax)


def _pixel_by_pixel(ax: Axes, result: Comparison, limit: int) -> None:
    """Draw events per pixel of one recording over those of the other, with the same pixels."""
    assert result.b is not None
    pair = [np.minimum(side.counts, limit).ravel() for side in (result.a, result.b)]
    joint = np.histogram2d(*pair, bins=min(limit + 1, 60), range=[[0, limit + 1]] * 2)[0]
    extent = (0, limit + 1, 0, limit + 1)
    ax.imshow(np.log10(joint.T + 1), origin="lower", extent=extent, cmap="Greys", aspect="equal")
    ax.plot([0, limit + 1], [0, limit + 1], ":", color=_B, lw=1)
    ax.set(title=f"events per pixel, r = {result.pixel_correlation:.3f}", xlabel="A", ylabel="B")
