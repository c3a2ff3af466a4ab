"""What ``blinkgl verify`` shows."""

from __future__ import annotations


from blinkgl.dataset.verify import verify_dataset
from blinkgl.terminal import plain_console

_MOST_LINES = 20


def verify_and_show(folder: str, *, deep: int = 0, seed: int = 0, base: str | None = None) -> bool:
    """:func:`~blinkgl.dataset.verify.verify_dataset` in words; True when nothing was found."""
    console = plain_console()
    say = lambda text: console.print(text, highlight=False, soft_wrap=True, markup=False)  # noqa: E731
    with console.status("looking") as status:
        result = verify_dataset(folder, deep=deep, seed=seed, base=base, progress=lambda number, name: status.update(f"{number}: {name}"))
    for name, lines in sorted(result.problems.items()):
        for line in lines[:_MOST_LINES]:
            say(f"{name}: {line}" if name != "." else line)
        if len(lines) > _MOST_LINES:
            say(f"{name}: … and {len(lines) - _MOST_LINES} more")
    for note in result.notes:
        say(note)
    made = f", {len(result.deep)} made again and compared bit by bit" if deep else ""
    bad = len(result.problems)
    say(f"{folder}: {result.sequences} sequences{made}: " + ("no problem found" if result.clean else f"problems in {bad} place{'s' * (bad != 1)}"))
    return result.clean
