"""What the charts of templates/charts.html draw: numbers in words, and histograms in the units of their picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

WIDTH, HEIGHT, BOTTOM, LEFT = 300, 120, 18, 6


@dataclass(frozen=True)
class Histogram:
    """``bars``: (left edge, height) of those that are not empty, on the line y = ``floor``; ``median_x`` is None where
    the median is off the axis. ``low``, ``high``, ``median``: values to be written below, the
    last one at ``label_x``."""

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
    values: np.ndarray, *, log: bool = False, bins: int = 36, span: tuple[float, float] | None = None
) -> Histogram | None:
    """Bars of ``values`` over ``span`` (default: the 0.1 … 99.9 % range); None without values. log: of the axis."""
    values = values[np.isfinite(values)]
    if log:
        values = values[values > 0]
    if not values.size:
        return None
    low, high = span or np.percentile(values, (0.1, 99.9))
    if log:
        low = max(low, float(values.min()), 1e-12) if not span else low
    if high <= low:
        low, high = low - 0.5 * (abs(low) or 1), high + 0.5 * (abs(high) or 1)
        log = False
    scale = np.log if log else (lambda v: np.asarray(v, float))
    edges = np.linspace(scale(low), scale(high), bins + 1)
    counts, _ = np.histogram(np.clip(scale(values), edges[0], edges[-1]), edges)
    step, room = (WIDTH - 2 * LEFT) / bins, HEIGHT - BOTTOM - 8
    bars = [
        (LEFT + i * step + 0.5, max(1.0, count / counts.max() * room))
        for i, count in enumerate(counts.tolist())
        if count
    ]

    def place(v: float) -> float:
        return LEFT + (float(scale(v)) - edges[0]) / (edges[-1] - edges[0]) * (WIDTH - 2 * LEFT)

    median = float(np.median(values))
    label = min(max(place(min(max(median, low), high)), LEFT + 60), WIDTH - LEFT - 60)
    return Histogram(
        bars, step - 1, float(low), float(high), median, place(median) if low <= median <= high else None, label
    )


def number(value: float) -> str:
    """Three significant digits, thousands as k, M, G."""
    if not np.isfinite(value):
        return "-"
    for limit, suffix in ((1e9, " G"), (1e6, " M"), (1e4, " k")):
        if abs(value) >= limit:
            return f"{value / (1e3 if suffix == ' k' else limit):.3g}{suffix}"
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def size(count: float) -> str:
    """Bytes as "12.3 MB"."""
    return f"{count / 1e9:.3g} GB" if count >= 1e9 else f"{count / 1e6:.3g} MB"
