"""``blinkgl trade --suite``: what was measured per scene and over all of them, as tables, and the files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.table import Table

from blinkgl.errors import ConfigError
from blinkgl.io.atomic import atomic_file, output_errors
from blinkgl.machine.terminal import plain_console, say
from blinkgl.show.trade import check_cost
from blinkgl.trade.fronts import fronts
from blinkgl.trade.pareto import excess
from blinkgl.trade.suite import OPTIONS, clips, run_suite


def run(
    folder: str | None,
    out: str,
    *,
    overrides: list[str],
    only: list[str],
    skip: list[str],
    scenes: list[str],
    resume: bool,
    limit_ms: float,
    rounds: int | None,
    minutes: float | None,
    cost: str,
    others: dict[str, bool],
) -> int:
    """Measures the scenes and writes the files. others : options of one scene, and whether they were given. Returns 3
    where a scene is missing, so that a script knows. Raises BlinkGLError."""
    check_cost(cost)
    if given := [name for name, said in others.items() if said]:
        raise ConfigError("is for one scene", where=", ".join(given), accepted="without --suite")
    console = plain_console()
    options = replace(OPTIONS, limit_us=round(limit_ms * 1000))
    result = run_suite(
        clips(folder, scenes),
        out,
        options=options if rounds is None else replace(options, rounds=rounds),
        only=only,
        skip=skip,
        overrides=overrides,
        minutes=minutes,
        cost=f"{cost}_s",
        resume=resume,
        say=lambda text: say(console, text),
    )
    show(result, console)
    names = ["suite.json", "suite.csv"]
    if any("settings" in scene for scene in result["scenes"].values()):
        path = Path(out) / "suite.png"
        with atomic_file(path) as file, output_errors(path):
            file.write_bytes(fronts(result, Path(out)))
        names.append(path.name)
    say(console, f"written to {out}: " + ", ".join(names))
    return 0 if result["complete"] else 3


def show(result: dict, console: Console) -> None:
    """Presets per scene, all settings over all scenes, and what does not count and why."""
    console.width = max(console.width, 140)
    cost, presets = result["cost"], result["presets"]
    table = Table(
        title="presets per scene: voxel error %, seconds per simulated second; * nothing beats it, else by how much "
        "another is better in both",
        title_justify="left",
    )
    table.add_column("scene", no_wrap=True)
    for quality in presets:
        table.add_column(quality, justify="right", no_wrap=True)
    table.add_column("rows that count", justify="right")
    for name, scene in result["scenes"].items():
        rows = {r["name"]: r for r in scene.get("settings", ())}
        sure = [r for r in rows.values() if r["trusted"]]
        table.add_row(
            name,
            *(_cell(rows.get(setting), sure, cost) for setting in presets.values()),
            f"{len(sure)} of {len(rows)}" if rows else "not measured",
        )
    if presets:
        console.print(table)
    table = Table(title="settings over all scenes (means are geometric), cheapest first", title_justify="left")
    headings = ("setting", "counts in", "not beaten in", "beaten by", "cost", "voxel", "worst voxel", "worst in")
    for name in headings:
        table.add_column(name, justify="left" if name in ("setting", "worst in") else "right", no_wrap=True)
    for r in sorted((r for r in result["standing"] if r["scenes"]), key=lambda r: r["cost"]):
        table.add_row(
            r["name"],
            str(r["scenes"]),
            str(r["undominated"]),
            f"{100 * max(r['excess'], 0):.0f} %",
            f"{r['cost']:.2f}",
            f"{100 * r['voxel']:.1f} %",
            f"{100 * r['worst_voxel']:.1f} %",
            r["worst_scene"],
        )
    console.print(table)
    for name, scene in result["scenes"].items():
        line = scene.get("reference") or f"not measured: {scene['error']}"
        console.print(
            f"{name}: {line}", highlight=False, soft_wrap=True, style="" if scene.get("converged") else "yellow"
        )
    if machines := dict.fromkeys(scene["machine"] for scene in result["scenes"].values() if "machine" in scene):
        console.print("; ".join(machines), highlight=False, soft_wrap=True)
    if result["missing"]:
        console.print(f"PARTIAL: without {', '.join(result['missing'])}", style="yellow")


def _cell(row: dict | None, sure: list[dict], cost: str) -> str:
    if row is None:
        return "-"
    figures = f"{100 * row['voxel']:.1f} {row[cost]:5.2f}"
    if not row["trusted"]:
        return figures + " (?)"
    beaten = excess(row, sure, cost, "voxel")
    return figures + (" *" if beaten <= 0 else f" {100 * beaten:.0f} %")
