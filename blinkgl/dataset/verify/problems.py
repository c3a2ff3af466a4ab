"""What looking at a data set finds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from blinkgl.config.sequence import SequenceConfig
from blinkgl.errors import BlinkGLError
from blinkgl.io.records import shown


@dataclass
class Verification:
    """``problems``: sequence (or "." for the data set) -> lines. ``notes``: what was not looked at, and why.

    ``deep``: sequences that were made again, the same bit by bit or not. ``in_part``: those of them that differ from
    what this machine makes and were made on another; there only what no machine has a say in was compared."""

    sequences: int = 0
    problems: dict[str, list[str]] = field(default_factory=dict)
    deep: list[str] = field(default_factory=list)
    in_part: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def clean(self) -> bool:
        return not self.problems

    def add(self, name: str, problems: list[str]) -> None:
        if problems:
            self.problems.setdefault(name, []).extend(problems)


@dataclass(frozen=True)
class Known:
    """A sequence without problems of its own."""

    folder: Path
    manifest: dict[str, Any]
    config: SequenceConfig


def guarded(check: Callable[[], list[str]]) -> list[str]:
    """``check()``, or as its only line what stopped it: libraries meet damaged files with exceptions of every kind."""
    try:
        return check()
    except BlinkGLError as error:
        return [str(error)]
    except Exception as error:  # noqa: BLE001
        return [f"cannot be checked: {type(error).__name__}: {shown(' '.join(str(error).split()))}"]
