"""``blinkgl trade``: the sweep and its files."""

from __future__ import annotations

import csv
import io
import json
import math
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from blinkgl.config.run import RunTemplate
from blinkgl.config.scene import RandomSceneConfig
from blinkgl.errors import ConfigError
from blinkgl.gl import create_context
from blinkgl.io.atomic import write_whole
from blinkgl.machine.bench import machine_line
from blinkgl.tools.trade.measure import ENOUGH, QUICK, Bench, Level, Options
from blinkgl.tools.trade.settings import SIZES, Setting, design, pareto_front

COLUMNS = (
    "name",
    "wall_s",
    "cpu_s",
    "frames_per_s",
    "triangles",
    "time_median_us",
    "time_p95_us",
    "shift_median_px",
    "shift_p95_px",
    "missed",
    "extra",
    "wrong",
    "count",
    "voxel",
    "flow_median_px",
    "flow_max_px",
    "events",
    "reference_events",
    "on_front",
)


def chosen(settings: tuple[Setting, ...], only: list[str], skip: Sequence[str] = ()) -> tuple[Setting, ...]:
    """Return the settings whose name contains one of ``only`` (default: all) and none of ``skip``. Raises ConfigError
    when none is left."""
    has = lambda s, texts: any(text.lower() in s.name.lower() for text in texts)
    chosen = tuple(s for s in settings if (not only or has(s, only)) and not has(s, skip))
    if not chosen:
        raise ConfigError(
            "no setting has this name",
            where="--only, --skip",
            value=", ".join([*only, *skip]),
            accepted="part of a name such as " + ", ".join(f"'{s.name}'" for s in settings[:3]),
        )
    return chosen


def trade(
    template: RunTemplate,
    *,
    quick: bool = False,
    only: list[str] | None = None,
    skip: list[str] | None = None,
    options: Options | None = None,
    cost: str = "wall_s",
    settings: tuple[Setting, ...] | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> dict[str, object]:
    """Return the whole measurement as plain data (the content of trade.json).

    cost : "wall_s" or "cpu_s", the cost axis of the front. settings : instead of the designed set.
    Raises BlinkGLError: errors of generating the sequence, or no setting of that name."""
    started = time.perf_counter()
    options = options or (QUICK if quick else Options())
    base = template.sequence(options.sequence)
    settings = settings or design(quick, isinstance(base.scene, RandomSceneConfig))
    settings = chosen(settings, only or [], skip or [])
    rows: list[dict] = []
    sizes: dict[str, dict] = {}
    with create_context(base.gl.backend, base.gl.device) as gl:
        for size in SIZES:
            mine = [s for s in settings if s.size == size]
            if not mine:
                continue
            bench = Bench(gl, template, options, size, say)
            say(
                f"{bench.width}x{bench.height}, {bench.duration_s:g} s of sequence {options.sequence}, {len(mine)} "
                "settings"
            )
            results = bench.measure(mine)
            levels = bench.judge(results, bench.speeds())
            rows += [{**r.to_dict(), "width": bench.width, "height": bench.height} for r in results]
            sizes[size or "full"] = _of_size(bench, levels)
        machine = machine_line(gl.renderer)
    main = rows[0]["size"]  # sizes are different data sets: the front uses only the largest
    best = {r["name"] for r in pareto_front([r for r in rows if r["size"] == main], cost, "voxel")}
    for r in rows:
        r["on_front"] = r["name"] in best
    return {
        "machine": machine,
        "config": template.tree,
        "sequence": options.sequence,
        "quick": quick,
        "reference_set": list(options.reference_set),
        "only": only or [],
        "skip": skip or [],
        "cost": cost,
        "error": "voxel",
        "size": main or "full",
        "limit_us": options.limit_us,
        "enough": ENOUGH,
        "rounds": max(len(r["wall_rounds"]) for r in rows),
        "seconds": time.perf_counter() - started,
        "sizes": sizes,
        "settings": rows,
        "front": [r["name"] for r in sorted(rows, key=lambda r: r[cost]) if r["on_front"]],
    }


def _of_size(bench: Bench, levels: list[Level]) -> dict[str, object]:
    """Return what is measured at one size, and how its reference converges, as plain data."""
    return {
        "width": bench.width,
        "height": bench.height,
        "judged_pixels": int(bench.mask.sum()),
        "tiles": len(bench.tiles),
        "t0_us": bench.t0_ns // 1000,
        "t1_us": bench.t1_ns // 1000,
        "clip_s": bench.duration_s,
        "emulator": bench.emulator.model_dump(),
        "levels": [level.to_dict() for level in levels],
        "converged": levels[-1].converged,
    }


def write(result: dict, out: str | Path) -> list[Path]:
    """Write trade.json, trade.csv, pareto.png and trade.html to the folder ``out``. Raises OutputError."""
    from blinkgl.tools.trade.plot import page, pareto

    paths = write_tables(Path(out) / "trade", result, COLUMNS, result["settings"])
    pages = [Path(out) / name for name in ("pareto.png", "trade.html")]
    picture = pareto(result)
    write_whole(pages[0], picture)
    write_whole(pages[1], page(result, picture))
    return [*paths, *pages]


def write_tables(path: Path, result: dict, columns: tuple[str, ...], rows: Iterable[dict]) -> list[Path]:
    """Write ``path``.json with the result, and ``path``.csv with the rows; return both paths. Raises OutputError."""
    paths, table = [path.with_suffix(ending) for ending in (".json", ".csv")], io.StringIO(newline="")
    write_whole(paths[0], json.dumps(plain(result), indent=1) + "\n")
    written = csv.DictWriter(table, columns, extrasaction="ignore")
    written.writeheader()
    written.writerows(rows)
    write_whole(paths[1], table.getvalue())
    return paths


def plain(value: object) -> Any:
    """Return a value for JSON, which has no NaN."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
