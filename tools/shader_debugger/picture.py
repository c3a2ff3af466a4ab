"""Arrays as pictures: colour maps, labelled PNGs with colour bars, the contact sheet,
error maps. matplotlib draws with Agg."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from PIL import Image

from blinkgl.io.atomic import atomic_file, output_errors
from blinkgl.io.pictures import picture
from blinkgl.tools.shader_debugger.moments import PASSES, Pass

ERROR_MAP = "inferno"
INK, PAPER, MUTED = "#1f2933", "#ffffff", "#64748b"


def png_bytes(rgb: np.ndarray) -> bytes:
    """Return a PNG file of (H, W, 3) uint8."""
    out = io.BytesIO()
    Image.fromarray(rgb).save(out, "PNG", compress_level=1)
    return out.getvalue()


# ------------------------------------------------------------------------------------------------- figures


def _style(axes) -> None:
    axes.set_xticks([]), axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color("#cbd5e1"), spine.set_linewidth(0.6)


def _legend(figure: Figure, box: tuple[float, float, float, float], legend: dict, size: float) -> None:
    """Draw the colour bar, or its replacement, into box (x, y, w, h in figure fractions)."""
    kind = legend["kind"]
    if kind == "bar":
        scale = (LogNorm if legend["log"] else Normalize)(legend["low"], legend["high"])
        axes = figure.add_axes(box)
        bar = figure.colorbar(ScalarMappable(scale, legend["map"]), cax=axes, orientation="horizontal")
        bar.outline.set_visible(False)
        if legend["log"]:
            # matplotlib would label only powers of ten, and a scale of depths may contain a single one.
            ticks = [float(f"{v:.1g}") for v in np.geomspace(legend["low"], legend["high"], 5)[1:-1]]
            bar.set_ticks(ticks, labels=[f"{v:g}" for v in ticks], minor=False)
            bar.minorticks_off()
        axes.tick_params(axis="x", labelsize=size, colors=MUTED, length=2, pad=1)
        return
    x, y, _, h = box
    text = {
        "mask": "white: yes, black: no",
        "ids": "one colour per number",
        "unit": "r, g, b = x, y, z; grey is 0",
        "uv": "r, g = fractional part of u, v",
        "light": f"sRGB, white = {legend.get('high', 1):.3g}",
        "wheel": f"hue: direction (+x red, +y yellow), saturated at {legend.get('high', 0):.3g}",
    }.get(kind, "")
    figure.text(x, y + h / 2, text, fontsize=size, color=MUTED, va="center")


def _save(figure: Figure, path: Path, palette: bool = False) -> None:
    """Save the figure. palette : 256 colours, dithered; a third of the size."""
    figure.set_dpi(100)
    figure.set_facecolor(PAPER)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])
    if palette:
        # Pillow dithers only to given palettes.
        image = image.quantize(palette=image.quantize(256), dither=Image.Dither.FLOYDSTEINBERG)
    with atomic_file(path) as temporary, output_errors(path):
        image.save(temporary, "PNG", optimize=palette)


def _title(figure: Figure, ends: tuple[float, float], y: float, texts: tuple[str, str]) -> None:
    """Write a line above a picture: its name at the left end, its unit at the right one (figure fractions)."""
    wide = 7.2 * len(texts[0]) + 5.4 * len(texts[1]) + 8  # px at these sizes
    scale = min(1.0, (ends[1] - ends[0]) * 100 * figure.get_figwidth() / wide)  # so that they do not overlap
    figure.text(ends[0], y, texts[0], fontsize=8.5 * scale, color=INK, va="center", weight="bold")
    figure.text(ends[1], y, texts[1], fontsize=7 * scale, color=MUTED, va="center", ha="right")


def save_labelled(path: Path, info: Pass, rgb: np.ndarray, legend: dict, caption: str) -> None:
    """Save one buffer: title with unit, the pixels enlarged by a whole factor, colour bar, caption."""
    height, width = rgb.shape[:2]
    # Whole factors, otherwise pixels would have different sizes.
    factor = max(1, round(700 / width))
    w, h, top, bottom = width * factor, height * factor, 46, 74
    W, H = w + 40, h + top + bottom
    figure = Figure(figsize=(W / 100, H / 100))
    axes = figure.add_axes((20 / W, bottom / H, w / W, h / H))
    axes.imshow(rgb, interpolation="nearest", aspect="auto"), _style(axes)
    subtitle = f"{info.unit}   ·   {info.source}".strip(" ·")
    _title(figure, (20 / W, 1 - 20 / W), 1 - 18 / H, (info.title, subtitle))
    _legend(figure, (20 / W, 44 / H, min(360, w) / W, 14 / H), legend, 8)
    figure.text(20 / W, 10 / H, caption, fontsize=7, color=MUTED, va="center")
    _save(figure, path)


def save_contact_sheet(path: Path, tiles: list[tuple[Pass, np.ndarray, dict]], caption: str, columns: int = 5) -> None:
    """Save all buffers on one page."""
    height, width = tiles[0][1].shape[:2]
    w = 232
    h = round(w * height / width)
    rows = -(-len(tiles) // columns)
    gap, head, foot, top = 14, 20, 32, 44
    # In px, at 100 a figure inch; matplotlib takes fractions of the page, from its lower left corner.
    W, H = columns * (w + gap) + gap, top + rows * (h + head + foot) + 4
    figure = Figure(figsize=(W / 100, H / 100))
    figure.text(gap / W, 1 - 22 / H, caption, fontsize=10, color=INK, va="center", weight="bold")
    for k, (info, rgb, legend) in enumerate(tiles):
        x = gap + (k % columns) * (w + gap)
        y = H - top - (k // columns) * (h + head + foot) - head - h
        axes = figure.add_axes((x / W, y / H, w / W, h / H))
        axes.imshow(rgb, interpolation="antialiased", aspect="auto"), _style(axes)
        _title(figure, (x / W, (x + w) / W), (y + h + 9) / H, (info.title, info.unit))
        _legend(figure, (x / W, (y - 12) / H, w / W, 8 / H), legend, 6)
    _save(figure, path, palette=True)


def save_errors(path: Path, reports: list, caption: str) -> None:
    """Save the error of each compared buffer on a logarithmic scale; pixels that are not graded are greyed."""
    tiles = []
    for report in reports:
        errors = np.clip(np.where(report.errors > 0, report.errors, 1e-9), 1e-9, 1e2)
        rgb, legend = picture("depth", errors, which="length", colours=ERROR_MAP, low=1e-9, high=1e2)
        # Greyed, not left out: a shape is easier to find with its surroundings.
        rgb[~report.graded] = (rgb[~report.graded] * 0.35 + 255 * 0.3).astype(np.uint8)
        verdict = "ok" if report.passed else "over tolerance"
        unit = f"{report.quantity.statistic} {report.value:.2g} {report.quantity.unit}: {verdict}"
        tiles.append((replace(PASSES[report.quantity.name], unit=unit), rgb, legend))
    save_contact_sheet(path, tiles, caption, columns=4)
