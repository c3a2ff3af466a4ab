"""Small charts as SVG text; colours come from the page's style sheet, so that they follow its theme."""

from __future__ import annotations

from html import escape

import numpy as np

WIDTH, HEIGHT, BOTTOM, LEFT = 300, 120, 18, 6


def histogram(values: np.ndarray, *, log: bool = False, bins: int = 36, span: tuple[float, float] | None = None, unit: str = "") -> str:
    """Bars of ``values`` over ``span`` (default: the 0.1 … 99.9 % range), with the median marked. log: of the axis."""
    values = values[np.isfinite(values)]
    if log:
        values = values[values > 0]
    if not values.size:
        return "<p class=none>no values</p>"
    low, high = span or np.percentile(values, (0.1, 99.9))
    if log:
        low = max(low, float(values.min()), 1e-12) if not span else low
    if high <= low:
        low, high = low - 0.5 * (abs(low) or 1), high + 0.5 * (abs(high) or 1)
        log = False
    scale = (np.log) if log else (lambda v: np.asarray(v, float))
    edges = np.linspace(scale(low), scale(high), bins + 1)
    counts, _ = np.histogram(np.clip(scale(values), edges[0], edges[-1]), edges)
    top = counts.max()
    place = lambda v: LEFT + (float(scale(v)) - edges[0]) / (edges[-1] - edges[0]) * (WIDTH - 2 * LEFT)
    body, floor = [], HEIGHT - BOTTOM
    step = (WIDTH - 2 * LEFT) / bins
    for i, count in enumerate(counts):
        if count:
            h = max(1.0, count / top * (floor - 8))
            body.append(f'<rect class=bar x="{LEFT + i * step + 0.5:.1f}" y="{floor - h:.1f}" width="{step - 1:.1f}" height="{h:.1f}"/>')
    median = float(np.median(values))
    if low <= median <= high:
        body.append(f'<line class=median x1="{place(median):.1f}" x2="{place(median):.1f}" y1="4" y2="{floor}"/>')
    body.append(f'<line class=axis x1="{LEFT}" x2="{WIDTH - LEFT}" y1="{floor}" y2="{floor}"/>')
    for value, anchor, x in ((low, "start", LEFT), (high, "end", WIDTH - LEFT)):
        body.append(f'<text x="{x}" y="{HEIGHT - 4}" text-anchor="{anchor}">{number(value)}</text>')
    x = min(max(place(min(max(median, low), high)), LEFT + 60), WIDTH - LEFT - 60)
    body.append(f'<text class=strong x="{x:.1f}" y="{HEIGHT - 4}" text-anchor="middle">{number(median)}{escape(" " + unit) if unit else ""}</text>')
    return _svg(body)


def bars(rows: list[tuple[str, float, float | None]]) -> str:
    """Horizontal bars (label, value, expected or None), as a table. The tick is the expectation."""
    top = max([v for _, v, _ in rows] + [e for _, _, e in rows if e is not None] + [1e-9])
    lines = []
    for label, value, expected in rows:
        tick = f'<i class=tick style="left:{100 * expected / top:.1f}%"></i>' if expected is not None else ""
        said = number(value) + (f" / {number(expected)}" if expected is not None else "")
        lines.append(f'<tr><td>{escape(label)}</td><td class=track><div><b style="width:{100 * value / top:.1f}%"></b>{tick}</div></td><td class=n>{said}</td></tr>')
    return "<table class=bars>" + "".join(lines) + "</table>"


def stacked(parts: list[tuple[str, float]]) -> str:
    """One bar of parts in proportion, with a legend."""
    total = sum(v for _, v in parts) or 1.0
    cells = "".join(f'<span class="s{i % 8}" style="flex:{v / total:.4f}" title="{escape(k)} {100 * v / total:.0f} %"></span>'
                    for i, (k, v) in enumerate(parts) if v > 0)
    legend = "".join(f'<li><i class="s{i % 8}"></i>{escape(k)} {100 * v / total:.0f} %</li>' for i, (k, v) in enumerate(parts) if v > 0)
    return f"<div class=stack>{cells}</div><ul class=legend>{legend}</ul>"


def number(value: float) -> str:
    """Three significant digits, thousands as k, M, G."""
    if not np.isfinite(value):
        return "-"
    for limit, suffix in ((1e9, " G"), (1e6, " M"), (1e4, " k")):
        if abs(value) >= limit:
            return f"{value / (1e3 if suffix == ' k' else limit):.3g}{suffix}"
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def _svg(body: list[str]) -> str:
    return f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role=img>' + "".join(body) + "</svg>"
