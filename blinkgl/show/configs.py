"""``blinkgl configs``: prints the shipped runs and their descriptions."""

from __future__ import annotations

from pathlib import Path

from rich.table import Table

from blinkgl.config.reader import shipped_runs
from blinkgl.machine.terminal import plain_console


def run() -> int:
    """Print one line per run: its name and the first sentence of its file."""
    table = Table(show_header=False, box=None)
    table.add_column(no_wrap=True)
    for name, path in sorted(shipped_runs().items()):
        table.add_row(name, _first_sentence(path))
    plain_console().print(table, highlight=False)
    return 0


def _first_sentence(path: Path) -> str:
    lines = path.read_text(encoding="utf-8").splitlines()
    about = []
    for line in lines:
        if not line.startswith("# ") or line.startswith("#   "):
            break
        about.append(line[2:].strip())
    return " ".join(about).split(". ")[0].rstrip(".") + "."
