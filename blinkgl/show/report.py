"""``blinkgl report``: where the page is."""

from __future__ import annotations

from blinkgl.report import write_report
from blinkgl.show.terminal import plain_console, say


def run(folder: str, out: str | None = None, *, examples: int = 6) -> int:
    """Arguments: of :func:`~blinkgl.report.write_report`."""
    say(plain_console(), f"written to {write_report(folder, out, examples=examples)}")
    return 0
