"""``blinkgl trade --suite``: the same settings on scenes with different difficulties.

One scene is not enough: filtering textures and filtering silhouettes help in different scenes. Each scene of
``configs/trade/`` is measured as by :func:`blinkgl.tools.trade.run.trade`, with its own reference density. The file is
written after each scene, so that an interrupted run leaves its results, marked as partial.

A row, one setting in one scene, counts only where the reference has converged to a tenth of the row's error.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from blinkgl.config.quality import QUALITIES, load_quality
from blinkgl.config.reader import apply_overrides
from blinkgl.config.run import RunTemplate, load_run
from blinkgl.errors import BlinkGLError, ConfigError
from blinkgl.tools.trade.measure import Density, Options
from blinkgl.tools.trade.run import chosen, trade, write_tables
from blinkgl.tools.trade.settings import Setting, excess, pareto_front, suite_design
from blinkgl.tools.trade.words import convergence_line
from blinkgl.types.trees import Tree

OPTIONS = Options(tiles=(3, 2, 14, 11), levels=Density(), reference_s=480.0, rounds=3, rounds_s=240.0, labels=False)
COLUMNS = (
    "scene",
    "name",
    "cpu_s",
    "wall_s",
    "frames_per_s",
    "voxel",
    "missed",
    "extra",
    "count",
    "time_median_us",
    "time_p95_us",
    "trusted",
    "on_front",
)


@dataclass(frozen=True)
class Trial:
    """A scene of the suite. what : the first sentence of its file: its difficulty."""

    name: str
    path: Path

    @property
    def what(self) -> str:
        with self.path.open(encoding="utf-8", errors="replace") as file:
            first = file.readline(1000)
        return first.removeprefix("#").strip() if first.startswith("#") else ""


def clips(folder: str | Path | None = None, only: Sequence[str] = ()) -> tuple[Trial, ...]:
    """Return the scenes of a folder (None: the shipped ones), by name, whose name contains one of ``only``. Raises
    ConfigError where there is none."""
    place = Path(str(resources.files("blinkgl.configs"))) / "trade" if folder is None else Path(folder)
    if not place.is_dir():
        raise ConfigError("the suite is a folder of scenes", where=str(folder), accepted="a folder with .yaml files")
    every = tuple(Trial(path.stem, path) for path in sorted(place.glob("*.yaml")))
    if not every:
        raise ConfigError("the folder has no scenes", where=str(folder), accepted="a folder with .yaml files")
    chosen = tuple(c for c in every if not only or any(text.lower() in c.name.lower() for text in only))
    if not chosen:
        raise ConfigError(
            "no scene has this name",
            where="--scene",
            value=", ".join(only),
            accepted="part of one of " + ", ".join(c.name for c in every),
        )
    return chosen


def run_suite(
    scenes: Sequence[Trial],
    out: str | Path,
    *,
    options: Options = OPTIONS,
    settings: tuple[Setting, ...] | None = None,
    only: Sequence[str] = (),
    skip: Sequence[str] = (),
    overrides: Sequence[str] = (),
    cost: str = "cpu_s",
    say: Callable[[str], None] = lambda _: None,
) -> dict[str, object]:
    """Measure every scene and write suite.json and suite.csv to the folder ``out``, again after each scene; return the
    content of the first.

    A scene that cannot be measured has a line with the reason. Raises BlinkGLError when none can."""
    out = Path(out)
    measured = chosen(settings or suite_design(), list(only), list(skip))
    asked = {"settings": [s.name for s in measured], "overrides": list(overrides), "cost": cost}
    done: dict[str, dict] = {}
    began, failed = time.perf_counter(), []
    for scene in scenes:
        say(f"{scene.name}: {scene.what}")
        try:
            done[scene.name] = _measured(scene, options, measured, overrides, cost, say)
        except BlinkGLError as error:
            failed.append(error)
            done[scene.name] = {"what": scene.what, "error": str(error)}
            say(f"{scene.name}: not measured: {error}")
        write(_whole(done, scenes, asked, time.perf_counter() - began), out)
    if len(failed) == len(done):
        raise failed[0]
    return _whole(done, scenes, asked, time.perf_counter() - began)


def _measured(
    scene: Trial,
    options: Options,
    settings: tuple[Setting, ...],
    overrides: Sequence[str],
    cost: str,
    say: Callable[[str], None],
) -> dict[str, object]:
    # The scene's usual labels, previews and read-outs are left out of the measurement.
    template = load_run(scene.path, list(overrides))
    result = trade(template, options=options, cost=cost, settings=settings, say=say)
    size = result["sizes"]["full"]
    rows = result["settings"]
    best = {r["name"] for r in pareto_front([r for r in rows if r["trusted"]], cost, "voxel")}
    for row in rows:
        row["on_front"] = row["name"] in best
        for key in ("sampling", "antialiasing", "other", "size", "overrides", "width", "height"):
            row.pop(key, None)
    return {
        "what": scene.what,
        "converged": size["converged"],
        "trusted": sum(r["trusted"] for r in rows),
        "reference": convergence_line(result),
        "machine": result["machine"],
        "seconds": result["seconds"],
        **{k: size[k] for k in ("width", "height", "judged_pixels", "clip_s", "levels")},
        "settings": rows,
        "front": [r["name"] for r in sorted(rows, key=lambda r: r[cost]) if r["on_front"]],
    }


def _whole(done: dict[str, dict], scenes: Sequence[Trial], asked: Tree, seconds: float) -> dict[str, object]:
    measured = {c.name: done[c.name] for c in scenes if c.name in done}
    missing = [c.name for c in scenes if "settings" not in measured.get(c.name, {})]
    return {
        "complete": not missing,
        "missing": missing,
        "asked": asked,
        "cost": asked["cost"],
        "error": "voxel",
        "seconds": seconds,
        "presets": preset_names(asked["settings"]),
        "scenes": measured,
        "standing": standing(measured, asked["cost"]),
    }


def preset_names(names: Iterable[str]) -> dict[str, str]:
    """Return quality -> name of its setting, for those among ``names``."""
    known = {s.name: meaning(s.overrides) for s in suite_design()}
    meanings = [(name, known[name]) for name in names if name in known]
    presets = {quality: meaning(f"{t}={json.dumps(v)}" for t, v in _tables(quality)) for quality in QUALITIES}
    return {quality: name for quality, wanted in presets.items() for name, meant in meanings if meant == wanted}


def _tables(quality: str) -> list[tuple[str, object]]:
    return [(table, load_quality(quality)[table]) for table in ("timeline", "render")]


def meaning(overrides: Iterable[str]) -> dict[str, object]:
    """Return the timeline and render settings that overrides give, with every value filled in."""
    config = RunTemplate(apply_overrides({"quality": None}, list(overrides)), Path()).sequence(0)
    return {"timeline": config.timeline.model_dump(), "render": config.render.model_dump()}


def standing(scenes: dict[str, dict], cost: str) -> list[dict[str, object]]:
    """Return per setting, over the scenes where its row counts, how often nothing beats it, and its worst result.

    excess : 0.1 means that another setting is 10 % better in both cost and error. The largest error is over all scenes,
    with the name of that scene."""
    names = dict.fromkeys(row["name"] for scene in scenes.values() for row in scene.get("settings", ()))
    result = []
    for name in names:
        counted = []
        for title, scene in scenes.items():
            rows = [r for r in scene.get("settings", ()) if r["trusted"]]
            counted += [(title, r, excess(r, rows, cost, "voxel")) for r in rows if r["name"] == name]
        if not counted:
            result.append({"name": name, "scenes": 0})
            continue
        worst = max(counted, key=lambda c: c[1]["voxel"])
        result.append(
            {
                "name": name,
                "scenes": len(counted),
                "undominated": sum(e <= 0 for *_, e in counted),
                "excess": max(e for *_, e in counted),
                "voxel": _mean(r["voxel"] for _, r, _ in counted),
                "cost": _mean(r[cost] for _, r, _ in counted),
                "worst_voxel": worst[1]["voxel"],
                "worst_scene": worst[0],
            }
        )
    return result


def _mean(values: Iterable[float]) -> float:
    """Return the geometric mean: scenes differ by factors."""
    logs = [math.log(max(v, 1e-12)) for v in values]
    return math.exp(sum(logs) / len(logs))


def write(result: Tree, out: Path) -> None:
    """Write suite.json and suite.csv. Raises OutputError."""
    scenes = result["scenes"].items()
    rows = ({"scene": name, **row} for name, scene in scenes for row in scene.get("settings", ()))
    write_tables(out / "suite", result, COLUMNS, rows)
