"""``blinkgl report``: prints the path of the page."""

from __future__ import annotations

from pathlib import Path

from blinkgl.dataset.cross_checks import guarded, lost
from blinkgl.machine.terminal import plain_console, say
from blinkgl.report.page import write_report
from blinkgl.sequence_files.index import made_folders


def run(folder: str, out: str | None = None, *, examples: int = 6, overwrite: bool = False) -> int:
    """Arguments and errors: of :func:`~blinkgl.report.write_report`."""
    console, page = plain_console(), write_report(folder, out, examples=examples, overwrite=overwrite)
    for line in guarded(lambda: lost(Path(folder), list(made_folders(folder)))):
        say(console, line)
    say(console, f"written to {page}")
    return 0
