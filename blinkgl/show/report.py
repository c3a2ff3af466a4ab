"""``blinkgl report``: prints the path of the page."""

from __future__ import annotations

from blinkgl.machine.terminal import plain_console, say
from blinkgl.report.page import write_report


def run(folder: str, out: str | None = None, *, examples: int = 6, overwrite: bool = False) -> int:
    """Arguments and errors: of :func:`~blinkgl.report.write_report`."""
    say(plain_console(), f"written to {write_report(folder, out, examples=examples, overwrite=overwrite)}")
    return 0
