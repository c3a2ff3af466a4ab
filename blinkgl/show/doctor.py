"""``blinkgl doctor``: sections, then what is missing with the commands that mend it."""

from __future__ import annotations

from rich.table import Table
from rich.text import Text

from blinkgl.errors import BlinkGLError
from blinkgl.machine.terminal import plain_console, say
from blinkgl.show.checks import Report, examine

_MARKS = {"ok": ("ok", "green"), "missing": ("MISSING", "bold red"), "absent": ("absent", "yellow"), "info": ("", "")}


def run(backend: str = "auto", device: int = 0, as_json: bool = False) -> int:
    """Status 2 when something required is missing."""
    report = examine(backend, device)
    if as_json:
        say(plain_console(), report.to_json())
    else:
        show(report)
    return 0 if report.ok else BlinkGLError.exit_status


def show(report: Report) -> None:
    """Print for people: sections, then what is missing with the commands that mend it."""
    console = plain_console(highlight=False)
    if not console.is_terminal:
        console = plain_console(highlight=False, width=200)  # piped: one check, one line, for grep
    table = Table.grid(padding=(0, 2))
    for _ in range(3):
        table.add_column(overflow="fold")
    section = ""
    for check in report.checks:
        if check.section != section:
            section = check.section
            table.add_row(Text(f"\n{section}" if table.row_count else section, style="bold"))
        mark, style = _MARKS[check.status]
        table.add_row(Text("  " + check.name), Text(mark, style=style), Text(check.value))
    console.print(table)
    for status, title in (("missing", "Missing, and required:"), ("absent", "Optional:")):
        mendable = [check for check in report.checks if check.status == status and check.remedy]
        if mendable:
            console.print(Text(f"\n{title}", style="bold"))
            for check in mendable:
                console.print(Text(f"  {check.name}: {check.remedy}"), soft_wrap=True)
    console.print(
        Text("\nAll required parts are there." if report.ok else "\nSomething required is missing.", style="bold")
    )
