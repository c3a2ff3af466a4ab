"""``blinkgl trade --suite``: prints the results over all scenes as a table, and writes the files."""

from __future__ import annotations

from dataclasses import replace

from rich.console import Console
from rich.table import Column, Table

from blinkgl.errors import ConfigError
from blinkgl.machine.terminal import plain_console, say
from blinkgl.tools.trade.command import check_cost
from blinkgl.tools.trade.suite import OPTIONS, clips, run_suite


def run(
    folder: str | None,
    out: str,
    *,
    overrides: list[str],
    only: list[str],
    skip: list[str],
    scenes: list[str],
    limit_ms: float,
    rounds: int | None,
    cost: str,
    others: dict[str, bool],
) -> int:
    """Measure the scenes and write the files. others : options of one scene, and whether they were given. Returns 3
    where a scene is missing, for scripts. Raises BlinkGLError."""
    check_cost(cost)
    if foreign := [name for name, set_here in others.items() if set_here]:
        raise ConfigError("these are options of a single scene", where=", ".join(foreign), accepted="without --suite")
    console = plain_console()
    options = replace(OPTIONS, limit_us=round(limit_ms * 1000))
    result = run_suite(
        clips(folder, scenes),
        out,
        options=options if rounds is None else replace(options, rounds=rounds),
        only=only,
        skip=skip,
        overrides=overrides,
        cost=f"{cost}_s",
        say=lambda text: say(console, text),
    )
    show(result, console)
    say(console, f"written to {out}: suite.json, suite.csv")
    return 0 if result["complete"] else 3


def show(result: dict, console: Console) -> None:
    """Print all settings over all scenes, and the rows that do not count, with reasons."""
    console.width = max(console.width, 140)
    title = "settings over all scenes (means are geometric), cheapest first"
    numbers = ("counts in", "not beaten in", "beaten by", "cost", "voxel", "worst voxel")
    columns = (Column(name, justify="right", no_wrap=True) for name in numbers)
    ends = (Column(name, no_wrap=True) for name in ("setting", "worst in"))
    table = Table(next(ends), *columns, next(ends), title=title, title_justify="left")
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
