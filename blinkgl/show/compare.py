"""``blinkgl compare``: prints two recordings side by side as a table, and writes files if requested."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from rich.table import Table

from blinkgl.io.atomic import write_whole
from blinkgl.machine.terminal import plain_console, say
from blinkgl.recordings.comparison import BLUR_PX, compare
from blinkgl.show.comparison_plot import plot


def run(a: str, b: str | None, out: str | None = None, **options: Any) -> int:
    """``options``: of :func:`~blinkgl.recordings.comparison.compare`. With ``out`` also
    compare.json and compare.png in that folder."""
    result = compare(a, b, **options)
    console = plain_console()
    intervals = len(result.edges_us) - 1
    table = Table(
        title=f"{result.duration_s:.6g} s from {result.edges_us[0] / 1e6:.6f} s in {intervals} "
        f"interval{'s' * (intervals > 1)}; mean (min … max) over them; polarity sums blurred by {BLUR_PX:g} px",
        title_justify="left",
    )
    table.add_column("")
    table.add_column(f"A {Path(result.a.name).name}")
    if result.b:
        table.add_column(f"B {Path(result.b.name).name}")
    for quantity, first, second in result.rows():
        table.add_row(*((quantity, first, second) if result.b else (quantity, first)))
    console.print(table, highlight=False)
    for note in result.notes:
        say(console, note)
    if out is not None:
        write_whole(os.path.join(out, "compare.json"), json.dumps(result.to_dict(), indent=1) + "\n")
        plot(result, os.path.join(out, "compare.png"))
        say(console, f"written to {out}: compare.json, compare.png")
    return 0
