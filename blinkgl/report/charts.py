"""Data of the charts in templates/charts.html: numbers as text, and histograms in units of their picture."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import TYPE_CHECKING

import cv2
import numpy as np

from blinkgl.errors import printable

if TYPE_CHECKING:
    import jinja2


WIDTH, HEIGHT, BOTTOM, LEFT = 300, 120, 18, 6


@dataclass(frozen=True)
class Histogram:
    """A histogram. ``bars``: (left edge, height) of the non-empty bars, on the line y = ``floor``; ``median_x`` is None
    where the median is off the axis. ``low``, ``high``, ``median``: values to write below, the last one at
    ``label_x``."""

    bars: list[tuple[float, float]]
    bar_width: float
    low: float
    high: float
    median: float
    median_x: float | None
    label_x: float
    width: int = WIDTH
    height: int = HEIGHT
    floor: int = HEIGHT - BOTTOM
    left: int = LEFT
    right: int = WIDTH - LEFT


def histogram(
    values: np.ndarray,
    *,
    log: bool = False,
    bins: int = 36,
    span: tuple[float, float] | None = None,
    whole: bool = False,
) -> Histogram | None:
    """Return bars of ``values`` over ``span`` (default: the 0.1 … 99.9 % range); None without values. log: logarithmic
    axis.   whole : counts, whose bars stand apart, and whose ``span`` begins and ends half a count outside of them."""
    values = values[np.isfinite(values)]
    if log:
        values = values[values > 0]
    if not values.size:
        return None
    low, high = span or np.percentile(values, (0.1, 99.9))
    if log:
        low = max(low, float(values.min()), 1e-12) if not span else low
    if high <= low:
        # Where all values are equal, the axis reaches half of them to both sides.
        low, high = low - 0.5 * (abs(low) or 1), high + 0.5 * (abs(high) or 1)
        log = False
    scale = np.log if log else (lambda v: np.asarray(v, float))
    edges = np.linspace(scale(low), scale(high), bins + 1)
    # Values beyond the span count in the first and the last bar.
    counts, _ = np.histogram(np.clip(scale(values), edges[0], edges[-1]), edges)
    step, room = (WIDTH - 2 * LEFT) / bins, HEIGHT - BOTTOM - 8
    width = min(0.7 * step, 24.0) if whole else step - 1
    # The rarest values keep a bar, 1 px high.
    bars = [
        (LEFT + i * step + (step - width) / 2, max(1.0, count / counts.max() * room))
        for i, count in enumerate(counts.tolist())
        if count
    ]

    def place(v: float) -> float:
        return LEFT + (float(scale(v)) - edges[0]) / (edges[-1] - edges[0]) * (WIDTH - 2 * LEFT)

    median = float(np.quantile(values, 0.5, method="inverted_cdf")) if whole else float(np.median(values))
    label = min(max(place(min(max(median, low), high)), LEFT + 60), WIDTH - LEFT - 60)
    return Histogram(
        bars=bars,
        bar_width=width,
        low=float(low) + 0.5 * whole,
        high=float(high) - 0.5 * whole,
        median=median,
        median_x=place(median) if low <= median <= high else None,
        label_x=label,
    )


def number(value: float) -> str:
    """Return three significant digits, thousands as k, M, G."""
    if not np.isfinite(value):
        return "-"
    # From where three digits of the unit below would be four.
    for least, unit, suffix in ((999.5e6, 1e9, " G"), (999.5e3, 1e6, " M"), (1e4, 1e3, " k")):
        if abs(value) >= least:
            return f"{value / unit:.3g}{suffix}"
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def size(count: float) -> str:
    """Return bytes as "12.3 MB"."""
    return f"{count / 1e9:.3g} GB" if count >= 999.5e6 else f"{count / 1e6:.3g} MB"


# ---------------------------------------------------------------------------------------------------------------------
# Pages from jinja2 templates. Inserted values are escaped, unless a template made them; a missing name is an error.


def render(name: str, **values: object) -> str:
    """Return the HTML text of a template ``"ROOM/FILE.html"``, which is templates/FILE.html of ``blinkgl.ROOM``."""
    return _environment().get_template(name).render(values)


def png(array: np.ndarray) -> str:
    """Return (H, W, 3) uint8 RGB as a data URI."""
    ok, data = cv2.imencode(".png", np.ascontiguousarray(array[..., ::-1]), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    assert ok
    return data_uri(data.tobytes())


def data_uri(file: bytes) -> str:
    """Return the bytes of a PNG file as a data URI."""
    return "data:image/png;base64," + base64.b64encode(file).decode()


@lru_cache(1)
def _environment() -> jinja2.Environment:
    import jinja2  # imported late: pages are written last

    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(_source),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=lambda value: printable(value, "\n\t") if type(value) is str else value,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(number=number, size=size)
    return environment


def _source(name: str) -> str:
    room, _, file = name.partition("/")
    return resources.files(f"blinkgl.{room}").joinpath("templates", file).read_text(encoding="utf-8")
