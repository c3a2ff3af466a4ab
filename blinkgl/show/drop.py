"""``blinkgl drop``: prints what was taken out."""

from __future__ import annotations

from collections.abc import Sequence

from blinkgl.dataset.drop import drop
from blinkgl.machine.terminal import plain_console, say


def run(root: str, names: Sequence[str], *, where: Sequence[str] = (), undo: bool = False) -> int:
    """Arguments and errors: of :func:`~blinkgl.dataset.drop.drop`."""
    done = drop(root, names, where, undo=undo)
    what = "no longer dropped; generate --resume makes them again" if undo else "dropped"
    say(plain_console(), f"{root}: {len(done)} sequence{'s' * (len(done) != 1)} {what}")
    return 0
