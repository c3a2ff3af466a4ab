"""The page: the results of :mod:`blinkgl.report.collect` in the text and charts of templates/data_set.html."""

from __future__ import annotations

from collections import Counter, defaultdict
from pathlib import Path

import cv2
import numpy as np

from blinkgl.dataset.run_folder import whole_set
from blinkgl.errors import OutputError
from blinkgl.io.atomic import refuse_file, write_whole
from blinkgl.report.charts import histogram, number, png, render, size
from blinkgl.report.collect import RANGES, Collected, Example, Parameter, collect, task_of
from blinkgl.sequence_files.index import write_index
from blinkgl.sequence_files.sequence_dir import MANIFEST
from blinkgl.types.numbers import is_number
from blinkgl.types.trees import Tree

_MAX_PICTURE_PX = 360
_MAX_LISTED = 50


def write_report(
    root: str | Path, out: str | Path | None = None, *, examples: int = 6, overwrite: bool = False
) -> Path:
    """Write the page, ``out``, or ``<root>/report.html`` and with it ``index.jsonl``; return the page's path.

    overwrite : replace an existing ``out``. Raises BlinkGLError."""
    own = out is None
    out = Path(root) / "report.html" if out is None else Path(out)
    if own and ((Path(root) / MANIFEST).is_file() or whole_set(Path(root)) != Path(root).resolve()):
        raise OutputError(
            "a page in a sequence or a split would be a foreign file", where=str(root), accepted="--out FILE"
        )
    refuse_file(out, overwrite or own)
    collected = collect(root, examples=examples)
    if own:
        write_index(root)
    write_whole(out, build_report(collected))
    return out


def build_report(collected: Collected) -> str:
    """Return the HTML text."""
    sequences, costs = collected.sequences, collected.costs
    groups = _groups(collected)
    kinds = Counter(f"{x['split']}, {x['emulator']}" for x in sequences)
    sizes = Counter(f"{x['width']}×{x['height']}" for x in sequences)
    simulated_us = collected.simulated_us
    return render(
        "report/data_set.html",
        title=f"Data set {collected.root.resolve().name}",
        most_listed=_MAX_LISTED,
        tiles=[
            (f"{len(simulated_us):,}", "sequences"),
            *([(f"{len(sequences):,}", "cameras")] if len(sequences) > len(simulated_us) else []),
            (f"{sum(simulated_us.values()) / 1e6:,.4g} s", "simulated"),
            (number(sum(x["events"] or 0 for x in sequences)), "events"),
            *_causes(sequences),
            (f"{sum(x['labels'] or 0 for x in sequences):,}", "flow labels"),
            (size(sum(x["bytes"] for x in sequences)), "on disk"),
        ],
        groups=groups,
        missing=any(made != wanted for _, made, wanted in groups),
        kinds=[(k, v, None) for k, v in sorted(kinds.items())],
        sizes=[(k, v, None) for k, v in sizes.most_common(8)],
        environment=collected.environment,
        examples=[_example(e) for e in collected.examples],
        distributions=_distributions(collected.quantities),
        parameters=[_parameter(p) for p in collected.parameters],
        cost=_cost(costs) if costs else None,
        failures=[*sorted(collected.failed.items()), *(("", line) for line in collected.unreadable)],
        retried=[c for c in costs if c["attempts"] > 1],
    )


def _causes(sequences: list[Tree]) -> list[tuple[str, str]]:
    """Return tiles: rates per pixel by cause, over the sequences that store causes."""
    known = [x for x in sequences if x.get("events_by_cause") and x["duration_us"]]
    pixel_seconds = sum(x["duration_us"] * 1e-6 * x["width"] * x["height"] for x in known)
    counts: Counter[str] = Counter()
    for x in known:
        counts.update(x["events_by_cause"])
    return [(f"{n / pixel_seconds:.3g} Hz/px", f"{cause} events") for cause, n in counts.items()]


def _groups(collected: Collected) -> list[tuple[str, int, int]]:
    """Return (group, sequences made, requested) per group."""
    if collected.plan is None:
        return []
    paths = {task_of(x) for x in collected.sequences}
    numbers = [number for path in paths if (number := collected.plan.tasks.number(path)) is not None]
    tasks, here = collected.plan.tasks, Counter(collected.plan.tasks[number].group for number in numbers)
    apart = Counter(tasks[number].group for name in collected.dropped if (number := tasks.number(name)) is not None)
    return [(name or "all", here[name], count - apart[name]) for name, count in collected.plan.counts.items()]


def _example(example: Example) -> Tree:
    pictures = [(title, png(_small(array))) for title, array in example.pictures]
    return {"name": example.name, "caption": example.caption, "pictures": pictures}


def _distributions(q: dict[str, np.ndarray]) -> list[tuple]:
    charts = [
        ("displacement", "Displacement from label to label", True, "px"),
        ("speed", "Image speed", True, "px/s"),
        ("rate", "Event rate", True, "events/s/px"),
        ("depth", "Depth", True, "m"),
        ("objects", "Bodies in view", False, ""),
        ("share", "Share of the image per body", True, ""),
    ]
    return [(title, unit, histogram(q[key], log=log)) for key, title, log, unit in charts if key in q and q[key].size]


def _parameter(p: Parameter) -> Tree:
    shown: dict[str, object] = {
        "path": p.path,
        "group": p.group or "all",
        "kind": p.kind,
        "count": len(p.values),
        "counts": None,
    }
    if p.kind not in RANGES:
        return {**shown, "counts": _counts(p)}
    # A normal distribution has its mean and its deviation before the two ends.
    low, high = (float(v) for v in p.spec[-2:])
    values = np.array(p.values, float)
    whole = p.kind == "integer"
    bins, span = (min(int(high - low) + 1, 40), (low - 0.5, high + 0.5)) if whole else (20, (low, high))
    coverage, outside = _coverage(values, low, high, p.kind)
    return {
        **shown,
        "histogram": histogram(values, log=p.kind == "log_uniform", span=span, bins=bins, whole=whole),
        "coverage": coverage,
        "outside": outside,
    }


def _coverage(values: np.ndarray, low: float, high: float, kind: str) -> tuple[str, int]:
    """Return "9 of 10 tenths of [0.18, 0.25] hit", and the number of values outside."""
    span = f"of [{number(low)}, {number(high)}]"
    if not values.size or high <= low:
        return f"range {span}", 0
    if kind == "integer":
        return f"{len(set(values.tolist()))} of {int(high - low) + 1} values {span} drawn", 0
    log = kind == "log_uniform"
    scaled = (np.log(values) - np.log(low)) / (np.log(high) - np.log(low)) if log else (values - low) / (high - low)
    hit = len(set(np.clip((scaled * 10).astype(int), 0, 9)))
    return f"{hit} of 10 tenths {span} hit", int(((scaled < -1e-9) | (scaled > 1 + 1e-9)).sum())


def _name(value: object) -> str:
    """Return a value as the recipe and a sequence's own file both name it: 60, 60.0 and "6e1" are one."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return f"{float(str(value)):.12g}" if is_number(str(value)) else str(value)


def _counts(p: Parameter) -> list[tuple[str, float, float | None]]:
    counted = Counter(map(_name, p.values))
    expected: defaultdict[str, float] = defaultdict(float)
    if p.kind == "shares":
        for part in p.spec:
            expected[_name(part["value"])] += float(part["share"])
    elif p.kind == "weighted":
        total = sum(float(w) for w in p.spec.values())
        expected |= {_name(k): float(w) / total for k, w in p.spec.items()}
    else:
        for value in p.spec:
            expected[_name(value)] += 1 / len(p.spec)
    return [(key, counted[key], share * len(p.values)) for key, share in expected.items()]


def _cost(costs: list[Tree]) -> Tree:
    seconds: defaultdict[str, float] = defaultdict(float)
    for c in costs:
        for stage, value in c["seconds"].items():
            seconds[stage] += value
        seconds["other"] += max(0.0, c["total_s"] - sum(c["seconds"].values()))
    total, simulated = sum(c["total_s"] for c in costs), sum(c["simulated_s"] for c in costs)
    facts = [
        ("wall time of all sequences", f"{total / 3600:.2f} h" if total > 3600 else f"{total:.1f} s"),
        ("per simulated second", f"{total / simulated:.2f} s" if simulated else "-"),
        ("processor time per sequence", f"{np.mean([c.get('cpu_s', np.nan) for c in costs]):.1f} s"),
        ("event frames", f"{sum(c['frames'] for c in costs):,}"),
        ("largest process", size(1024 * max(c["peak_rss_kib"] for c in costs))),
        ("made at the first attempt", f"{sum(c['attempts'] == 1 for c in costs)} of {len(costs)}"),
    ]
    return {
        "stages": sorted(seconds.items(), key=lambda kv: -kv[1]),
        "facts": facts,
        "wall": histogram(np.array([c["total_s"] for c in costs]), log=True),
        "bytes": histogram(np.array([c["bytes"] for c in costs], float), log=True),
    }


def _small(array: np.ndarray) -> np.ndarray:
    scale = min(1.0, _MAX_PICTURE_PX / array.shape[1])
    return cv2.resize(array, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else array
