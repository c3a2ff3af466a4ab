"""The noise of single pixels that a still scene showed, as a page: beside what the fit makes of it."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np

from blinkgl.report.markup import data_uri, render

if TYPE_CHECKING:
    from blinkgl.recordings.pixel_noise import PixelFit

_COLOURS = {"recorded": "#222222", "fitted": "#1764ab"}


def page(result: PixelFit, sensor_text: str) -> str:
    """The HTML text. sensor_text : of the sensor file."""
    return render(
        "report/pixel_noise.html",
        title=f"noise of single pixels fitted to {result.recording.rsplit('/', 1)[-1]}",
        result=result,
        rows=rows(result),
        parameters=parameters(result),
        picture=data_uri(picture(result)),
        sensor=sensor_text,
    )


def rows(result: PixelFit) -> list[tuple[str, str, str]]:
    """(quantity, recorded, fitted) of the half that was not fitted, as text."""
    return [
        ("events", f"{result.recorded:,}", f"{result.simulated:,}"),
        ("pixels that fired", f"{result.fired[0]:,}", f"{result.fired[1]:,}"),
        ("events of a pixel that fired, KS", "0", f"{result.counts_distance:.3f}"),
        ("interval between a pixel's events, KS", "0", f"{result.intervals_distance:.3f}"),
    ]


def parameters(result: PixelFit) -> list[tuple[str, str, str]]:
    """(key, fitted, what is to be said)."""
    found = []
    for key, field in type(result.config).model_fields.items():
        value = getattr(result.config, key)
        if key in result.untold:
            found.append((f"readout.pixels.{key}", "", result.untold[key]))
        elif value != field.default:
            spread = result.uncertainty.get(key)
            text = f"{value:.4g}" + (f" ± {spread:.2g}" if spread is not None else "")
            found.append((f"readout.pixels.{key}", text, field.description or ""))
    return found


def picture(result: PixelFit) -> bytes:
    """PNG: how many events pixels made, and the intervals between them."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, NullFormatter

    figure = Figure(figsize=(12, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    for (name, colour), counts, gaps in zip(_COLOURS.items(), result.counts, result.intervals):
        ordered = np.sort(counts)
        left.step(ordered, 1 - np.arange(len(ordered)) / len(ordered), where="pre", color=colour, label=name)
        if len(gaps):
            right.plot(np.sort(gaps) / 1000, np.arange(1, len(gaps) + 1) / len(gaps), color=colour)
    left.set(title="pixels that fired: at least so many events", xlabel="events", ylabel="share", xscale="log")
    left.set_yscale("log")
    left.legend(frameon=False, fontsize=9)
    right.set(title="interval between a pixel's events", xlabel="ms", ylabel="share below", xscale="log", ylim=(0, 1))
    for ax in (left, right):
        ax.spines[["top", "right"]].set_visible(False)
        ax.grid(alpha=0.25)
    for axis in (left.xaxis, left.yaxis, right.xaxis):  # without mathematical fonts
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
    file = io.BytesIO()
    figure.savefig(file, dpi=100, format="png", metadata={"Software": None})
    return file.getvalue()
