"""What workers tell a run, and the log of each sequence."""

from __future__ import annotations

import time
from pathlib import Path

from blinkgl.types.trees import Tree

Message = Tree
RUN_FOLDER = ".run"
"""Below the data set: recipe, logs, costs. Readers of the data set skip hidden folders, and its content is not
compared."""


class SequenceLog:
    """Appends to ``.run/logs/<split>/<sequence>.log``. A log that cannot be written stops nothing."""

    def __init__(self, out: str | Path, name: str):
        self.path = Path(out) / RUN_FOLDER / "logs" / f"{name}.log"

    def write(self, text: str) -> None:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with open(self.path, "a", encoding="utf-8") as file:
                file.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {text.rstrip()}\n")
        except OSError:
            pass
