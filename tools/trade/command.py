"""``blinkgl trade``: prints the best settings as a table, and writes the files."""

from __future__ import annotations

from dataclasses import replace

from rich.console import Console
from rich.table import Column, Table

from blinkgl.config.run import load_run
from blinkgl.errors import ConfigError
from blinkgl.machine.terminal import plain_console, say
from blinkgl.tools.trade.measure import QUICK, Options
from blinkgl.tools.trade.run import trade, write
from blinkgl.tools.trade.words import convergence_line


def run(
    config: str | None,
    out: str,
    *,
    suite_options: list[str],
    overrides: list[str],
    quick: bool,
    only: list[str],
    skip: list[str],
    sequence: int | None,
    clip: float | None,
    limit_ms: float,
    rounds: int | None,
    minutes: float | None,
    cost: str,
    reference_set: list[str] | None = None,
    seed: int | None = None,
) -> int:
    """Measure the settings, write the files, and print those that no other one beats. Raises BlinkGLError."""
    if config is None:
        raise ConfigError("no scene given", where="trade", accepted="a YAML file, or --suite for the shipped scenes")
    if suite_options:
        raise ConfigError(
            "these are options of the suite", where=", ".join(suite_options), accepted="together with --suite"
        )
    check_cost(cost)
    template = load_run(config, overrides, seed=seed)
    options = QUICK if quick else Options()
    half_s = None if minutes is None else minutes * 30
    changes: dict[str, object] = {
        "limit_us": round(limit_ms * 1000),
        "sequence": template.sequence(0).output.first_index if sequence is None else sequence,
        "reference_set": tuple(reference_set or ()),
        "clip_s": clip,
        "rounds": rounds,
        "rounds_s": half_s,
        "reference_s": half_s,
    }
    console = plain_console()
    result = trade(
        template,
        quick=quick,
        only=only,
        skip=skip,
        options=replace(options, **{key: value for key, value in changes.items() if value is not None}),
        cost=f"{cost}_s",
        say=lambda text: say(console, text),
    )
    show(result, console)
    paths = write(result, out)
    say(console, f"written to {out}: " + ", ".join(p.name for p in paths))
    return 0


def check_cost(cost: str) -> None:
    """Raise ConfigError for a cost that is neither wall nor cpu."""
    if cost not in ("wall", "cpu"):
        raise ConfigError("unknown cost", where="--cost", value=cost, accepted="wall or cpu")


def show(result: dict, console: Console) -> None:
    """Print the front as a table, and how far the reference can be trusted."""
    console.width = max(console.width, 120)
    title = "settings that no other one beats in cost and error, cheapest first"
    names = ("wall s/s", "cpu s/s", "frames/s", "time µs 50/95 %", "shift px 50/95 %", "missed/extra", "voxel grid")
    columns = (Column(name, justify="right", no_wrap=True) for name in names)
    table = Table("setting", *columns, title=title, title_justify="left")
    for r in sorted((r for r in result["settings"] if r["on_front"]), key=lambda r: r[result["cost"]]):
        table.add_row(
            r["name"],
            f"{r['wall_s']:.2f}",
            f"{r['cpu_s']:.2f}",
            f"{r['frames_per_s']:.0f}",
            f"{r['time_median_us']:.0f}/{r['time_p95_us']:.0f}",
            f"{r['shift_median_px']:.3f}/{r['shift_p95_px']:.3f}",
            f"{100 * r['missed']:.1f}/{100 * r['extra']:.1f} %",
            f"{100 * r['voxel']:.1f} %",
        )
    console.print(table)
    console.print(result["machine"], highlight=False, soft_wrap=True)
    for name, size in result["sizes"].items():
        line = convergence_line(result, name)
        console.print(
            ("" if name == "full" else f"{name}: ") + line,
            highlight=False,
            soft_wrap=True,
            style="" if size["converged"] else "yellow",
        )
