"""The picture of a comparison: rates over time, counts per pixel, intervals, correlations."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.io.atomic import atomic_file, output_errors
from blinkgl.recordings.comparison import IEI_EDGES_US, Comparison, RecordingSide

_A, _B = "#1764ab", "#d1495b"
Side = tuple[RecordingSide, str, str]
"""A recording, its letter and its colour."""


def plot(result: Comparison, path: str | os.PathLike) -> None:
    """One PNG of six panels. OutputError when it cannot be written."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    sides = [(result.a, "A", _A)] + ([(result.b, "B", _B)] if result.b else [])
    figure = Figure(figsize=(13, 7.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 3)
    figure.suptitle("   ".join(f"{tag}: {Path(s.name).name}, {s.count:,} events" for s, tag, _ in sides), fontsize=11)
    _rates(axes[0, 0], result, sides)
    top = max(1.0, *(float(np.percentile(s.counts, 99.5)) for s, _, _ in sides))
    for ax, (side, tag, _) in zip((axes[0, 1], axes[0, 2]), sides):
        image = ax.imshow(side.counts, cmap="magma", vmin=0, vmax=top)
        ax.set(title=f"{tag}: events per pixel", xticks=[], yticks=[])
        figure.colorbar(image, ax=ax, shrink=0.7)
    if result.b is None:
        axes[0, 2].axis("off")
    _intervals(axes[1, 0], sides)
    _correlations(axes[1, 1], result, sides)
    _pixel_by_pixel(axes[1, 2], result, int(top) + 1)
    for ax in (axes[0, 0], axes[1, 0], axes[1, 1]):
        ax.spines[["top", "right"]].set_visible(False)
        ax.grid(alpha=0.25)
    with atomic_file(path) as temporary, output_errors(path):
        figure.savefig(temporary, dpi=110, metadata={"Software": None})


def _rates(ax: Any, result: Comparison, sides: list[Side]) -> None:
    for side, tag, colour in sides:
        rate = np.append(side.rate_hz, side.rate_hz[-1:]) / 1e6
        ax.step(result.edges_us / 1e6, rate, where="post", color=colour, label=tag)
    ax.set(title="event rate", xlabel="time [s]", ylabel="M events/s", ylim=(0, None))
    ax.legend(frameon=False)


def _intervals(ax: Any, sides: list[Side]) -> None:
    for side, tag, colour in sides:
        density = side.iei / max(side.iei.sum(), 1)
        ax.step(IEI_EDGES_US / 1000, np.append(density, density[-1:]), where="post", color=colour, label=tag)
    ax.set(title="interval between a pixel's events", xlabel="ms", ylabel="share per bin", xscale="log", ylim=(0, None))
    if len(used := np.flatnonzero(sum(s.iei for s, _, _ in sides))):
        ax.set_xlim(IEI_EDGES_US[used[0]] / 1000, IEI_EDGES_US[used[-1] + 1] / 1000)


def _correlations(ax: Any, result: Comparison, sides: list[Side]) -> None:
    middle = (result.edges_us[:-1] + result.edges_us[1:]) / 2e6
    for side, tag, colour in sides:
        if side.frame_correlation is not None:
            ax.plot(middle, side.frame_correlation, "o-", ms=3, color=colour, label=f"{tag} : frames, Δ ln(I+10)")
    if result.polarity_correlation is not None:
        ax.plot(middle, result.polarity_correlation, "s--", ms=3, color="0.35", label="A : B")
    ax.set(title="polarity sum per interval, correlation", xlabel="time [s]", ylim=(min(0, *ax.get_ylim()), 1))
    if ax.get_lines():
        ax.legend(frameon=False, fontsize=9)
    else:
        ax.axis("off")


def _pixel_by_pixel(ax: Any, result: Comparison, limit: int) -> None:
    """Events per pixel of one recording over those of the other, where they have the same pixels."""
    if not result.same_size or result.b is None:
        ax.axis("off")
        return
    pair = (np.minimum(side.counts, limit).ravel() for side in (result.a, result.b))
    joint = np.histogram2d(*pair, bins=min(limit + 1, 60), range=[[0, limit + 1]] * 2)[0]
    extent = (0, limit + 1, 0, limit + 1)
    ax.imshow(np.log10(joint.T + 1), origin="lower", extent=extent, cmap="Greys", aspect="equal")
    ax.plot([0, limit + 1], [0, limit + 1], ":", color=_B, lw=1)
    ax.set(title=f"events per pixel, r = {result.pixel_correlation:.3f}", xlabel="A", ylabel="B")
