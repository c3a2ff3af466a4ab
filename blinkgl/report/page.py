"""The page itself. Everything is inside it: pictures as data URIs, charts as SVG, no script, nothing fetched."""

from __future__ import annotations

import base64
from collections import Counter
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from blinkgl.io.atomic import atomic_file, output_errors
from blinkgl.io.index import write_index
from blinkgl.report.charts import bars, histogram, number, stacked
from blinkgl.report.collect import Collected, Example, Parameter, collect

_MAX_PICTURE_PX = 360
_MAX_LISTED = 50


def write_report(root: str | Path, out: str | Path | None = None, *, examples: int = 6) -> Path:
    """Writes the page (default ``<root>/report.html``) and ``index.jsonl``; returns the page's path. Raises BlinkGLError."""
    found = collect(root, examples=examples)
    out = Path(out) if out is not None else Path(root) / "report.html"
    write_index(root)
    with atomic_file(out) as path, output_errors(path):
        path.write_text(build_report(found), encoding="utf-8")
    return out


def build_report(found: Collected) -> str:
    """The HTML text."""
    style = resources.files("blinkgl.report").joinpath("style.css").read_text(encoding="utf-8")
    title = f"Data set {found.root.resolve().name}"
    sections = [_overview(found), _examples(found.examples), _distributions(found.quantities), _parameters(found.parameters), _cost(found.costs),
                _failures(found)]
    return (f"<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'><title>{escape(title)}</title>"
            f"<style>{style}</style><main><h1>{escape(title)}</h1>" + "".join(sections) + "</main></html>\n")


def _overview(found: Collected) -> str:
    s = found.sequences
    seconds = sum(x["duration_us"] or 0 for x in s) / 1e6
    tiles = [("sequences", f"{len(s):,}"), ("simulated", f"{seconds:,.4g} s"), ("events", number(sum(x["events"] or 0 for x in s))),
             ("flow labels", f"{sum(x['labels'] or 0 for x in s):,}"), ("on disk", _bytes(sum(x["bytes"] for x in s)))]
    cells = "".join(f"<div><b>{value}</b><span>{label}</span></div>" for label, value in tiles)
    rows = []
    if found.plan is not None:
        here = Counter()
        paths = {x["path"] for x in s}
        planned = Counter(task.group for task in found.plan.tasks)
        for task in found.plan.tasks:
            here[task.group] += task.name in paths
        rows = [(name or "all", here[name], planned[name]) for name in planned]
    complete = all(made == wanted for _, made, wanted in rows)
    groups = bars([(name, made, wanted) for name, made, wanted in rows]) if rows else "<p class=none>no record of the recipe</p>"
    kinds = Counter(f"{x['split']}, {x['emulator']}" for x in s)
    sizes = Counter(f"{x['width']}×{x['height']}" for x in s)
    note = "" if complete else "<p class=bad>Some sequences that the recipe asks for are missing.</p>"
    machine = ", ".join(f"{k} {v}" for k, v in found.environment.items())
    return (f"<div class=tiles>{cells}</div>{note}<div class=grid><section><h3>Groups of the recipe: made / asked for</h3>{groups}</section>"
            f"<section><h3>Splits and emulators</h3>{bars([(k, v, None) for k, v in sorted(kinds.items())])}</section>"
            f"<section><h3>Sizes</h3>{bars([(k, v, None) for k, v in sizes.most_common(8)])}</section></div>"
            + (f"<p class=dim>Made with {escape(machine)}</p>" if machine else ""))


def _examples(examples: list[Example]) -> str:
    if not examples:
        return ""
    rows = []
    for e in examples:
        pictures = "".join(f'<img alt="{label}" src="{_picture(array)}">' if array is not None else "<span class=none>no frame</span>"
                           for label, array in (("frame", e.image), ("events", e.events), ("flow", e.flow)))
        pictures += "".join(f'<span><img alt="{escape(title)}" src="{_picture(array)}"><small>{escape(title)}</small></span>' for title, array in e.others)
        rows.append(f"<figure><div class=triple>{pictures}</div><figcaption><b>{escape(e.name)}</b> {escape(e.caption)}</figcaption></figure>")
    return ("<h2>Examples</h2><p class=dim>Frame, events (ON blue, OFF red) and optical flow (hue is direction, saturation is speed) of one label each, then the other labels that there are.</p>"
            f"<div class=figures>{''.join(rows)}</div>")


def _distributions(q: dict[str, np.ndarray]) -> str:
    charts = [("displacement", "Displacement from label to label", True, "px"), ("speed", "Image speed", True, "px/s"),
              ("rate", "Event rate", True, "events/s/px"), ("depth", "Depth", True, "m"), ("objects", "Bodies in view", False, ""),
              ("share", "Share of the image per body", True, "")]
    cells = "".join(f"<section><h3>{title}</h3>{histogram(q[key], log=log, unit=unit)}</section>" for key, title, log, unit in charts
                    if key in q and q[key].size)
    if not cells:
        return ""
    return (f"<h2>Distributions</h2><p class=dim>Of a sample of labels and pixels; event rates of all sequences. The line is the median; axes from the "
            f"0.1 to the 99.9 % quantile, logarithmic but for counts.</p><div class=grid>{cells}</div>")


def _parameters(parameters: list[Parameter]) -> str:
    cells = []
    for p in parameters:
        head = f"<h3>{escape(p.path)}</h3><p class=dim>{escape(p.group or 'all')}: {escape(p.kind)}, {len(p.values)} sequences</p>"
        if p.kind in ("uniform", "log_uniform", "integer"):
            low, high = (float(v) for v in p.spec)
            values = np.array(p.values, float)
            whole = p.kind == "integer"
            bins = min(int(high - low) + 1, 40) if whole else 20
            span = (low - 0.5, high + 0.5) if whole else (low, high)
            body = histogram(values, log=p.kind == "log_uniform", span=span, bins=bins) if values.size else "<p class=none>no sequences</p>"
            body += f"<p class=dim>{_coverage(values, low, high, p.kind)}</p>"
        else:
            body = bars(_counts(p))
        cells.append(f"<section>{head}{body}</section>")
    if not cells:
        return ""
    return ("<h2>Parameters against the recipe</h2><p class=dim>What was drawn, over the range or beside the share (tick) that the recipe gives.</p>"
            f"<div class=grid>{''.join(cells)}</div>")


def _coverage(values: np.ndarray, low: float, high: float, kind: str) -> str:
    """"9 of 10 tenths of [0.18, 0.25] are hit"."""
    said = f"of [{number(low)}, {number(high)}]"
    if not values.size or high <= low:
        return f"range {said}"
    if kind == "integer":
        return f"{len(set(values.tolist()))} of {int(high - low) + 1} values {said} drawn"
    log = kind == "log_uniform"
    scaled = (np.log(values) - np.log(low)) / (np.log(high) - np.log(low)) if log else (values - low) / (high - low)
    hit = len(set(np.clip((scaled * 10).astype(int), 0, 9)))
    outside = int(((scaled < -1e-9) | (scaled > 1 + 1e-9)).sum())
    return f"{hit} of 10 tenths {said} hit" + (f"; <b class=bad>{outside} outside</b>" if outside else "")


def _counts(p: Parameter) -> list[tuple[str, float, float | None]]:
    counted = Counter(str(v) for v in p.values)
    if p.kind == "shares":
        expected = Counter()
        for part in p.spec:
            expected[str(part["value"])] += float(part["share"])
    elif p.kind == "weighted":
        total = sum(float(w) for w in p.spec.values())
        expected = Counter({str(k): float(w) / total for k, w in p.spec.items()})
    else:
        expected = Counter()
        for value in p.spec:
            expected[str(value)] += 1 / len(p.spec)
    return [(key, counted[key], share * len(p.values)) for key, share in expected.items()]


def _cost(costs: list[dict[str, Any]]) -> str:
    if not costs:
        return ""
    seconds = Counter()
    for c in costs:
        seconds.update(c["seconds"])
        seconds["other"] += max(0.0, c["total_s"] - sum(c["seconds"].values()))
    total, simulated = sum(c["total_s"] for c in costs), sum(c["simulated_s"] for c in costs)
    facts = [("wall time of all sequences", f"{total / 3600:.2f} h" if total > 3600 else f"{total:.1f} s"),
             ("per simulated second", f"{total / simulated:.2f} s" if simulated else "-"), ("processor time per sequence", f"{np.mean([c.get('cpu_s', np.nan) for c in costs]):.1f} s"), ("event frames", f"{sum(c['frames'] for c in costs):,}"),
             ("largest process", _bytes(1024 * max(c["peak_rss_kib"] for c in costs))),
             ("made at the first attempt", f"{sum(c['attempts'] == 1 for c in costs)} of {len(costs)}")]
    table = "".join(f"<tr><td>{k}</td><td class=n>{v}</td></tr>" for k, v in facts)
    per = np.array([c["total_s"] for c in costs])
    return (f"<h2>Cost</h2>{stacked(sorted(seconds.items(), key=lambda kv: -kv[1]))}<div class=grid><section><table>{table}</table></section>"
            f"<section><h3>Wall time per sequence</h3>{histogram(per, log=True, unit='s')}</section>"
            f"<section><h3>Bytes per sequence</h3>{histogram(np.array([c['bytes'] for c in costs], float), log=True, unit='B')}</section></div>")


def _failures(found: Collected) -> str:
    rows = [(name, reason) for name, reason in sorted(found.failed.items())] + [("", line) for line in found.unreadable]
    retried = [c for c in found.costs if c["attempts"] > 1]
    parts = []
    if rows:
        lines = "".join(f"<tr><td>{escape(name)}</td><td>{escape(reason)}</td></tr>" for name, reason in rows[:_MAX_LISTED])
        more = f"<p class=dim>and {len(rows) - _MAX_LISTED} more</p>" if len(rows) > _MAX_LISTED else ""
        parts.append(f"<table class=failures>{lines}</table>{more}")
    if retried:
        parts.append("<p>Made at a later attempt: " + escape(", ".join(f"{c['name']} ({c['attempts']})" for c in retried[:_MAX_LISTED])) + "</p>")
    return "<h2>Failures</h2>" + ("".join(parts) or "<p class=dim>None.</p>")


def _picture(array: np.ndarray) -> str:
    scale = min(1.0, _MAX_PICTURE_PX / array.shape[1])
    if scale < 1:
        array = cv2.resize(array, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    ok, data = cv2.imencode(".png", np.ascontiguousarray(array[..., ::-1]), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    assert ok
    return "data:image/png;base64," + base64.b64encode(data.tobytes()).decode()


def _bytes(size: float) -> str:
    return f"{size / 1e9:.3g} GB" if size >= 1e9 else f"{size / 1e6:.3g} MB"
