"""What a layout is: the files of one published data set, made from a sequence directory."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from blinkgl.layouts.source import Source


class Missing(NamedTuple):
    """What a sequence lacks, in words, and the YAML line that makes it."""

    what: str
    yaml: str


class Layout:
    """One layout; a row of the table is an instance.

    name : as ``--layout`` has it.   about : what opens it, for tables.   size : (height, width) that its loaders have
    written into their code, None: any; other sizes are exported and said."""

    name: str
    about: str
    size: tuple[int, int] | None = None

    def missing(self, source: Source) -> list[Missing]:
        """What ``source`` lacks and its loaders cannot do without."""
        raise NotImplementedError

    def folder(self, source: Source) -> str:
        """Where its files go, below the export."""
        return f"{source.split}/{source.name}"

    def write(self, source: Source, folder: Path) -> list[str]:
        """Makes the files of ``source`` in ``folder``, which is there. Returns what a person should know of, a line
        each. Raises AssetError: a file of the sequence is damaged; OutputError."""
        raise NotImplementedError


def needs_flow(source: Source) -> list[Missing]:
    """What nearly every layout asks for."""
    return [] if source.flow_times("forward") else [Missing("forward flow", "labels: {flow: [forward]}")]
