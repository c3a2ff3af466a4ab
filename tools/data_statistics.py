"""Does simulated data lie where recordings lie? Statistics of both, a picture and a page.

    python -m blinkgl.tools.data_statistics configs/eflow/real_data.yaml --recordings ../shared/data/events \\
        --page docs/eflow_statistics.md --picture docs/images/eflow_statistics.png

Both are cut into windows (5 to 100 ms, log-uniform, drawn) of 128x128 px: a recording into as many as cover it (tiles
of its sensor, windows one after the other), the recipe as training gets it (:mod:`eflow.data.online`). Of every pair:

| statistic | what it is |
|---|---|
| events | per pixel of the new window |
| ON | share of ON among the events |
| interval | between two events of one pixel, ms, median |
| repeats | events per pixel that has any |
| edge | width of the region that fired, px: twice its area over its outline |
| flow | length of the displacement over the window, px: true, or contrast maximisation's where FWL > 1.05 |
| density | events per pixel and px of flow |

A recording is *inside* by as many of its windows as lie between the 1st and the 99th percentile of the recipe.

The bursts of "ecd_rotation" are the test of the networks: they stand here as an evaluation of the recipe, which is not
tuned on them.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from blinkgl.errors import BlinkGLError
from blinkgl.io.formats import open_events
from blinkgl.types.events import Events
from eflow.config import SourceConfig
from eflow.data.online import open_online
from eflow.data.window import Window
from eflow.methods.iwe import flow_warp_loss
from eflow.methods.table import make_method

SIDE = 128
WINDOW_MS = (5.0, 100.0)
LEAST = 40
"""Events in a window; emptier ones are no samples, neither here nor in training."""
SHARPER = 1.05
TEST = "ecd_rotation"
STATISTICS = {
    "events": "events per pixel",
    "on": "share of ON",
    "interval": "interval, ms",
    "repeats": "events per active pixel",
    "edge": "width of active region, px",
    "flow": "flow, px",
    "density": "events per pixel and px of flow",
}


def statistics(old: Window, new: Window, side: tuple[int, int], flow_px: float | None) -> dict[str, float]:
    """Of a pair of windows of (H, W) px; flow_px: mean length of the flow, None where nobody knows. NaN: not known."""
    height, width = side
    place = new.y.astype(np.int64) * width + new.x
    counts = np.bincount(place, minlength=height * width)
    order = np.argsort(place, kind="stable")
    same = np.diff(place[order]) == 0
    gaps = np.diff(new.t[order])[same]
    events = len(new) / counts.size
    known = flow_px is not None and flow_px > 0.1
    return {
        "events": events,
        "on": float(np.concatenate([old.p, new.p]).mean()),
        "interval": float(np.median(gaps)) / 1000 if len(gaps) > 10 else np.nan,
        "repeats": float(counts.sum() / max((counts > 0).sum(), 1)),
        "edge": edge_width((counts > 0).reshape(side)),
        "flow": flow_px if known else np.nan,
        "density": events / flow_px if known else np.nan,
    }


def edge_width(hit: np.ndarray) -> float:
    """Twice the area of (H, W) bool over the length of its outline: the width of a long line."""
    framed = np.pad(hit, 1).astype(np.int8)
    outline = np.abs(np.diff(framed, axis=0)).sum() + np.abs(np.diff(framed, axis=1)).sum()
    return float(2 * hit.sum() / max(outline, 1))


def tiles(events: Events, height: int, width: int, rng: np.random.Generator) -> Iterator[tuple[Window, Window]]:
    """Pairs of windows that cover a recording, of lengths drawn anew after each pair."""
    t, end = int(events.t[0]), int(events.t[-1])
    shortest, longest = 1000 * WINDOW_MS[0], min(1000 * WINDOW_MS[1], (end - t) / 2)
    while shortest < longest:
        span = int(np.exp(rng.uniform(np.log(shortest), np.log(longest))))
        if t + 2 * span > end:
            return
        pair = [events.window(t + k * span, t + (k + 1) * span) for k in (0, 1)]
        for top, left in itertools.product(range(0, height - SIDE + 1, SIDE), range(0, width - SIDE + 1, SIDE)):
            windows = []
            for k, e in enumerate(pair):
                inside = (e.x >= left) & (e.x < left + SIDE) & (e.y >= top) & (e.y < top + SIDE)
                own = e.part(inside)
                begin = t + k * span
                windows.append(
                    Window(own.x - np.uint16(left), own.y - np.uint16(top), own.t, own.p, begin, begin + span)
                )
            if min(map(len, windows)) >= LEAST:
                yield windows[0], windows[1]
        t += span


def of_recording(path: Path, most: int, motions: int) -> tuple[list[dict[str, float]], str]:
    """Statistics of at most ``most`` windows of a recording, evenly spaced, the flow of ``motions`` of them; and what
    it is, in words. Raises BlinkGLError."""
    events, height, width = read(path)
    found = list(tiles(events, height, width, np.random.default_rng(0)))
    chosen = [found[i] for i in np.unique(np.linspace(0, len(found) - 1, min(most, len(found))).round().astype(int))]
    estimate = make_method("contrast-translation", None)
    moved = {int(i) for i in np.linspace(0, len(chosen) - 1, min(motions, len(chosen))).round()} if chosen else set()
    rows = []
    for i, (old, new) in enumerate(chosen):
        length = None
        if i in moved:
            flow = estimate(old, new, SIDE, SIDE)
            if flow_warp_loss(new, flow) > SHARPER:
                length = float(np.hypot(*np.moveaxis(flow, -1, 0)).mean())
        rows.append(statistics(old, new, (SIDE, SIDE), length))
    return rows, f"{width}x{height}, {(events.t[-1] - events.t[0]) / 1e6:.2f} s, {len(events)} events"


def read(path: Path) -> tuple[Events, int, int]:
    """Events, height and width of a recording; evbench's .mat too (y and polarity turned over). Raises BlinkGLError."""
    if path.suffix != ".mat":
        file = open_events(path).sized()
        return file.read(), file.height, file.width
    from scipy.io import loadmat

    table = {k: v.ravel() for k, v in loadmat(path).items() if k in ("ts", "x", "y", "pol")}
    t = table["ts"].astype(np.int64)
    columns = table["x"].astype(np.uint16), (179 - table["y"].astype(np.int64)).astype(np.uint16), t
    return Events(*columns, (1 - (table["pol"] > 0)).astype(np.uint8)), 180, 190


def recordings(root: Path) -> list[Path]:
    """Every file below ``root`` that is one, by folder."""
    endings = (".aedat4", ".aedat", ".raw", ".mat")
    text = ("events.txt", "events_chunk.txt")
    return sorted(p for p in root.rglob("*") if p.suffix in endings or p.name in text)


def of_recipe(recipe: str, count: int, workers: int) -> list[dict[str, float]]:
    """Statistics of ``count`` samples as training gets them."""
    asked = dict(samples=10, window_ms=WINDOW_MS, min_events=LEAST, max_flow=40)
    rows = []
    with open_online(SourceConfig(recipe=recipe, online=True, workers=workers, **asked), 0) as source:
        for n in range(count):
            s = source[n]
            length = float(np.hypot(*s.flow[s.valid].T).mean()) if s.valid.any() else None
            rows.append(statistics(s.old, s.new, (s.height, s.width), length))
    return rows


def column(rows: list[dict[str, float]], name: str) -> np.ndarray:
    """Of a statistic, those that are known."""
    values = np.array([row[name] for row in rows], float)
    return values[np.isfinite(values)]


def inside(rows: list[dict[str, float]], made: np.ndarray, name: str) -> float:
    """Share of the windows between the 1st and the 99th percentile of ``made``; NaN: none is known."""
    values = column(rows, name)
    low, high = np.percentile(made, (1, 99))
    return float(((values >= low) & (values <= high)).mean()) if len(values) else np.nan


def draw(made: dict[str, np.ndarray], found: dict[str, list[dict[str, float]]], path: Path) -> None:
    """A panel per statistic: the recipe as a band and a histogram, a line from 10 to 90 % and a dot per recording."""
    names = list(found)
    size = (17, 1.2 + 0.33 * len(names))
    figure, axes = plt.subplots(1, len(STATISTICS), figsize=size, layout="constrained", sharey=True)
    for axis, (key, title) in zip(axes, STATISTICS.items(), strict=True):
        log = key != "on"
        low, high = np.percentile(made[key], (1, 99))
        axis.axvspan(low, high, color="tab:blue", alpha=0.12, linewidth=0)
        edges = np.geomspace(low, high, 31) if log else np.linspace(low, high, 31)
        heights = np.histogram(made[key], edges)[0]
        floor = len(names) + 0.35  # (the y axis points down)
        axis.stairs(floor - 0.85 * heights / heights.max(), edges, baseline=floor, fill=True)
        for row, name in enumerate(names):
            values = column(found[name], key)
            if len(values):
                a, b, c = np.percentile(values, (10, 50, 90))
                colour = "tab:red" if name.startswith(TEST) else "black"
                axis.plot([a, c], [row, row], color=colour, linewidth=1.6)
                axis.plot(b, row, "o", color=colour, markersize=4)
        if log:
            axis.set_xscale("log")
        axis.set_title(title, fontsize=9)
        axis.tick_params(labelsize=8)
        axis.grid(alpha=0.25, axis="x")
    axes[0].set_yticks([*range(len(names)), len(names)], [*names, "recipe"], fontsize=8)
    axes[0].set_ylim(len(names) + 0.4, -0.6)
    figure.savefig(path, dpi=90, metadata={"Software": None})


def page(
    command: str,
    made: dict[str, np.ndarray],
    found: dict[str, list[dict[str, float]]],
    said: dict[str, str],
    picture: str,
) -> str:
    """The page, Markdown."""
    head = "| | windows | " + " | ".join(STATISTICS.values()) + " |\n|---|---|" + "---|" * len(STATISTICS)
    number = lambda v: "–" if not np.isfinite(v) else f"{v:.2g}"
    middle = lambda values: number(np.median(values)) if len(values) else "–"
    lines = [f"| **recipe** | {len(made['events'])} | " + " | ".join(middle(made[k]) for k in STATISTICS) + " |"]
    spans = (f"{number(np.percentile(made[k], 1))} … {number(np.percentile(made[k], 99))}" for k in STATISTICS)
    lines.append("| 1 … 99 % of it | | " + " | ".join(spans) + " |")
    for name, rows in found.items():
        lines.append(f"| {name} | {len(rows)} | " + " | ".join(middle(column(rows, k)) for k in STATISTICS) + " |")
    shares = []
    for name, rows in found.items():
        values = [inside(rows, made[k], k) for k in STATISTICS]
        shares.append(f"| {name} | " + " | ".join("–" if np.isnan(v) else f"{100 * v:.0f} %" for v in values) + " |")
    bins = np.array([0, 0.02, 0.05, 0.1, 0.2, 0.5, 1, np.inf])
    share = np.histogram(made["density"], bins)[0] / len(made["density"])
    spans = [f"{a:g} to {b:g}" if np.isfinite(b) else f"above {a:g}" for a, b in itertools.pairwise(bins)]
    density = ", ".join(f"{100 * part:.0f} % {span}" for part, span in zip(share, spans, strict=True))
    about = "\n".join(f"- {name}: {text}" for name, text in said.items())
    heads = " | ".join(STATISTICS.values())
    return f"""# Recordings and the recipe for them

Where `configs/eflow/real_data.yaml`, which `configs/eflow/real.yaml` trains on, lies beside recordings of cameras:

```
{command}
```

Pairs of windows of 128x128 px and 5 to 100 ms; a recording is cut into tiles and windows that cover it, the recipe
is what training gets (before its augmentations, which drop events and add noise). Those of fewer than {LEAST} events
are left out of both. The flow of a recording is contrast maximisation's translation, of a few windows, where it makes
the events sharper (FWL above {SHARPER}). `python -m blinkgl.tools.data_statistics --help` says what each column is.

![Statistics of the recipe and of recordings]({picture})

Blue: 1st to 99th percentile and histogram of the recipe. Lines: 10 to 90 % of a recording's windows; dots: medians.
Red: the two bursts of `{TEST}`, the test of the networks, here as an evaluation. They were in the first of these
pictures, too; what was changed after it (more blank scenes, higher thresholds) follows from the black ones alone, of
which most were sparser than the recipe was.

## Medians

{head}
{chr(10).join(lines)}

Density of the recipe's samples, events per pixel and px of flow: {density}.

## Windows of recordings inside 1 … 99 % of the recipe

| | {heads} |
|---|{"---|" * len(STATISTICS)}
{chr(10).join(shares)}

## Recordings

{about}
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recipe")
    parser.add_argument("--recordings", type=Path, required=True)
    parser.add_argument("--page", type=Path, required=True)
    parser.add_argument("--picture", type=Path, required=True)
    parser.add_argument("--samples", type=int, default=800)
    parser.add_argument("--windows", type=int, default=150, help="of a recording")
    parser.add_argument("--motions", type=int, default=8, help="windows of a recording whose flow is estimated")
    parser.add_argument("--workers", type=int, default=1)
    a = parser.parse_args()
    rows = of_recipe(a.recipe, a.samples, a.workers)
    found, said = {}, {}
    paths = recordings(a.recordings)
    for path in paths:
        alone = sum(p.parent == path.parent for p in paths) == 1
        name = (path.parent if alone else path.with_suffix("")).relative_to(a.recordings).as_posix()
        try:
            seen, said[name] = of_recording(path, a.windows, a.motions)
        except BlinkGLError as error:
            print(f"left out: {error}")
            continue
        if seen:
            found[name] = seen
        else:
            said[name] += f"; shorter than two windows of {WINDOW_MS[0]:g} ms, or none with {LEAST} events: left out"
    if not found:
        raise SystemExit(f"no recording below {a.recordings}")
    made = {key: column(rows, key) for key in STATISTICS}
    draw(made, found, a.picture)
    command = f"python -m blinkgl.tools.data_statistics {a.recipe} --recordings DIR --samples {a.samples}"
    a.page.write_text(page(command, made, found, said, f"images/{a.picture.name}"), encoding="utf-8")


if __name__ == "__main__":
    main()
