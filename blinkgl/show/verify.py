"""``blinkgl verify``: prints the problems by place, and a summary."""

from __future__ import annotations

from blinkgl.dataset.verify import Verification, verify_dataset
from blinkgl.errors import BlinkGLError
from blinkgl.io.records import shown
from blinkgl.machine.terminal import plain_console, say

_MOST_LINES = 20


def run(folder: str, *, deep: int = 0, seed: int = 0, base: str | None = None) -> int:
    """Print the result of :func:`~blinkgl.dataset.verify.verify_dataset`; status 2 when something is wrong."""
    console = plain_console()
    with console.status("looking") as status:
        result = verify_dataset(
            folder, deep=deep, seed=seed, base=base, progress=lambda number, name: status.update(f"{number}: {name}")
        )
    for name, lines in sorted(result.problems.items()):
        for line in lines[:_MOST_LINES]:
            say(console, f"{shown(name)}: {line}" if name != "." else line)
        if len(lines) > _MOST_LINES:
            say(console, f"{shown(name)}: … and {len(lines) - _MOST_LINES} more")
    for note in result.notes[:_MOST_LINES]:
        say(console, f"note: {note}")
    if len(result.notes) > _MOST_LINES:
        say(console, f"note: … and {len(result.notes) - _MOST_LINES} more")
    say(console, f"{folder}: {last_line(result, bool(deep))}")
    return 0 if result.clean else BlinkGLError.exit_status


def last_line(result: Verification, deep: bool) -> str:
    """Return "20 sequences, 3 made again and compared bit by bit: no problem found"; it also counts what was compared
    in part or not at all."""
    parts = [f"{result.sequences} sequences"]
    if result.dropped:
        parts.append(f"{result.dropped} dropped on purpose")
    if deep:
        parts.append(f"{len(result.deep) - len(result.in_part)} made again and compared bit by bit")
    if result.in_part:
        parts.append(f"{len(result.in_part)} made again and compared in part")
    bad = len(result.problems)
    verdict = (
        f"problems in {bad} place{'s' * (bad != 1)}"
        if bad
        else "no problem found" + (" in what could be compared" if result.notes else "")
    )
    return ", ".join(parts) + f": {verdict}"
