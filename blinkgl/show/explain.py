"""``blinkgl explain``: prints what a run models, leaves out and costs, as tables."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from blinkgl.config.run import load_run
from blinkgl.dataset.explain import Explanation, explain
from blinkgl.dataset.report import shares
from blinkgl.machine.terminal import clock, plain_console, say, size


def run(config: str, *, sequence: int | None = None, seed: int | None = None, overrides: Sequence[str] = ()) -> int:
    """Explain a run. ``sequence``: default the first of the run."""
    show(explain(load_run(config, overrides, seed=seed), sequence), plain_console())
    return 0


def show(result: Explanation, console: Console) -> None:
    """Print three tables and the cost."""
    scene = Table(title="what is modelled", title_justify="left", show_header=False)
    for key, value in result.scene.items():
        scene.add_row(key, value)
    console.print(scene)
    passes = Table(title="what is computed", title_justify="left")
    for column, side in (("pass", "left"), ("why", "left"), ("times", "right")):
        passes.add_column(column, justify=side)
    for p in result.passes:
        passes.add_row(p.name, p.why, f"{p.count:,}")
    console.print(passes)
    left = Table(title="what is left out", title_justify="left", show_header=False)
    for what, why in result.left_out:
        left.add_row(what, why)
    console.print(left)
    say(
        console,
        f"expected: about {result.frames:,} event frames, {result.processor_s:.1f} s of processor, "
        f"{result.seconds:.1f} s by the clock as this machine is now and {size(result.bytes)} a sequence "
        f"({result.seconds_per_simulated_second:.1f} s of processor per simulated second; {shares(result.stages)}; on "
        f"{result.machine}); {result.sequences:,} in one process: "
        f"{clock(result.run_seconds)} and {size(result.sequences * result.bytes)}",
    )
