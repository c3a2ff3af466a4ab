"""The page of a calibration: before and after compared with the recording, one self-contained HTML file."""

from __future__ import annotations

import io
from typing import Any

import cv2
import numpy as np

from blinkgl.recordings.calibration import Calibration
from blinkgl.recordings.clip import TILE_PX, polarity_sums
from blinkgl.recordings.comparison import BLUR_PX
from blinkgl.recordings.statistics import COUNTS, ISI_BINS, ISI_PER_DECADE, sums
from blinkgl.report.charts import data_uri, render

_COLOURS = {"recorded": "#222222", "before": "#e9a13b", "fitted": "#1764ab"}


def page(result: Calibration, sensor_text: str) -> str:
    """Return the HTML text. sensor_text : text of the sensor file."""
    a, b = result.halves
    span = lambda part: (result.clip.edges_us[list(part)] - result.clip.edges_us[0]) / 1e6
    return render(
        "report/calibration.html",
        title=f"{result.config.emulator} fitted to {result.recording.rsplit('/', 1)[-1]}",
        result=result,
        emulator=result.config.emulator,
        rows=rows(result),
        parameters=parameters(result),
        spans=(span(a), span(b)),
        picture=data_uri(picture(result)),
        sensor=sensor_text,
    )


def rows(result: Calibration) -> list[tuple[str, list[str]]]:
    """Return (quantity, [recorded, before, fitted] of the fitted half, then of the other) as text."""
    table = []
    text = lambda v, form: "–" if np.isnan(v) else form.format(v)
    sides = list(zip(result.judged_before, result.judged))
    each = lambda recorded, of: [cell for b, f in sides for cell in (recorded(f), of(b), of(f))]
    table.append(("events", each(lambda j: f"{j.recorded:,}", lambda j: f"{j.events:,}")))
    table.append(("event ratio", each(lambda j: "1", lambda j: f"{j.rate_ratio:.3f}")))
    table.append(("ON / OFF", each(lambda j: f"{j.recorded_on_off:.3f}", lambda j: f"{j.on_off:.3f}")))
    table.append(("intervals, KS", each(lambda j: "0", lambda j: f"{j.interval_distance:.3f}")))
    if not np.isnan(result.judged[0].polarity_correlation):
        table.append(("polarity, correlation", each(lambda j: "1", lambda j: f"{j.polarity_correlation:.3f}")))
        table.append(("events of a pixel, correlation", each(lambda j: "1", lambda j: f"{j.count_correlation:.3f}")))
    if not np.isnan(result.judged[0].still_hz):
        table.append(
            (
                "still pixels, Hz",
                each(lambda j: text(j.recorded_still_hz, "{:.3g}"), lambda j: text(j.still_hz, "{:.3g}")),
            )
        )
    return table


def parameters(result: Calibration) -> list[tuple[str, str, str, str]]:
    """Return (key, before, fitted, remark) of every parameter that the fit may change."""
    table = []
    for key in result.config.fitted:
        before, after = getattr(result.before, key), getattr(result.config, key)
        before = "" if before is None else f"{before:g}"
        if key in result.values:
            table.append((key, before, f"{after:.4g} ± {result.uncertainty[key]:.2g}", ""))
        else:
            remark = result.undetermined.get(key, "kept fixed by request")
            table.append((key, before, "" if after is None else f"{after:.4g}", remark))
    return table


def picture(result: Calibration) -> bytes:
    """Return a PNG: rates over time, intervals, counts, and polarity sums of one interval that was not fitted."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    clip, last = result.clip, result.halves[1][1]
    streams = {"recorded": clip.events, "before": result.simulated_before, "fitted": result.simulated}
    held = {name: sums(events, clip, *result.halves[1]) for name, events in streams.items()}
    figure = Figure(figsize=(13, 7.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 3)
    edges = (clip.edges_us - clip.edges_us[0]) / 1e6

    ax = axes[0, 0]
    for name, events in streams.items():
        rate = np.diff(np.searchsorted(events.t, clip.edges_us)) / np.diff(edges) / 1e3
        # A step needs a value at its end, too.
        ax.step(edges, np.append(rate, rate[-1:]), where="post", color=_COLOURS[name], label=name)
    ax.axvspan(edges[result.halves[1][0]], edges[last], color="0.93", zorder=0)
    ax.set(title="event rate (grey: not fitted)", xlabel="s", ylabel="thousand events/s", ylim=(0, None))
    ax.legend(frameon=False, fontsize=9)

    ax = axes[0, 1]
    # Bins begin at 1 µs; the axis is in ms.
    bins = 10 ** (np.arange(ISI_BINS) / ISI_PER_DECADE) / 1000
    for name, one in held.items():
        isi = one.isi.sum(axis=(0, 1))
        ax.plot(bins, np.cumsum(isi) / max(isi.sum(), 1), color=_COLOURS[name])
    ax.set(title="interval between a pixel's events", xlabel="ms", ylabel="share below", xscale="log", ylim=(0, 1))
    shown = np.flatnonzero(sum(one.isi.sum(axis=(0, 1)) for one in held.values()))
    if len(shown):
        ax.set_xlim(bins[shown[0]], bins[shown[-1]])

    ax = axes[0, 2]
    moved = held["recorded"].pixels[:, 0].sum() > 0
    for name, one in held.items():
        counts = (one.counts if moved else one.still_counts).sum(axis=0)
        share = np.where(counts > 0, counts / max(counts.sum(), 1), np.nan)
        ax.plot(range(len(COUNTS)), share, "o-", ms=3, color=_COLOURS[name])
    of = "a pixel's events in an interval" if moved else "a pixel's events"
    ax.set(title=of, ylabel="share of the pixels", yscale="log")
    ax.set_xticks(range(len(COUNTS)), [f"{c}+" if c > 3 else f"{c}" for c in COUNTS], fontsize=8, rotation=45)

    k = (result.halves[1][0] + last - 1) // 2
    window = lambda events: events.window(int(clip.edges_us[k]), int(clip.edges_us[k + 1]))
    images = {
        name: cv2.GaussianBlur(polarity_sums(window(events), clip.size), (0, 0), BLUR_PX)
        for name, events in streams.items()
    }
    top = max(float(np.percentile(np.abs(images["recorded"]), 99.5)), 0.1)
    for ax, (name, image) in zip(axes[1], images.items()):
        ax.imshow(mosaic(image), cmap="RdBu_r", vmin=-top, vmax=top)
        ax.set(title=f"{name}: ON - OFF, {edges[k]:.3f} to {edges[k + 1]:.3f} s", xticks=[], yticks=[])
        ax.set_xlabel("" if clip.share == 1 else f"squares of {TILE_PX} px, drawn at random over the sensor")
    _plain(axes[0])
    file = io.BytesIO()
    figure.savefig(file, dpi=100, format="png", metadata={"Software": None})
    return file.getvalue()


def mosaic(image: np.ndarray) -> np.ndarray:
    """Return the tiles of a clip in rows, as a nearly square picture; the one tile of a whole sensor is returned
    unchanged.

    image : (n TILE_PX, TILE_PX), stacked tiles.   Returns (r TILE_PX, c TILE_PX), 0 where there is no tile."""
    count = len(image) // TILE_PX
    if image.shape[1] != TILE_PX or count < 2:
        return image
    columns = int(np.ceil(np.sqrt(count)))
    rows = -(-count // columns)
    tiles = np.zeros((rows * columns, TILE_PX, TILE_PX), image.dtype)
    tiles[:count] = image[: count * TILE_PX].reshape(count, TILE_PX, TILE_PX)
    return tiles.reshape(rows, columns, TILE_PX, TILE_PX).swapaxes(1, 2).reshape(rows * TILE_PX, columns * TILE_PX)


def _plain(axes: Any) -> None:
    """Draw plots without frames, and numbers without mathematical fonts."""
    from matplotlib.ticker import FuncFormatter, NullFormatter

    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.grid(alpha=0.25)
    for axis in (axes[1].xaxis, axes[2].yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
