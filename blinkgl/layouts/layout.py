"""What a layout is: the files of one published data set, made from a sequence directory."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from blinkgl.layouts.source import Source


class Missing(NamedTuple):
    """What a sequence lacks, in words, and the YAML line that makes it."""

    what: str
    yaml: str


Need = Callable[[Source], "Missing | None"]
"""What loaders cannot do without, asked of a sequence: None where it is there, or where another need speaks of it."""


class Layout:
    """One layout; a row of the table is an instance.

    name : as ``--layout`` has it.   about : what opens it, for tables.   size : (height, width) that its loaders have
    written into their code, None: any; other sizes are exported and said.   needs : what its loaders ask for.
    splits : folders that its loaders want to be there, empty or not."""

    name: str
    about: str
    size: tuple[int, int] | None = None
    needs: tuple[Need, ...] = ()
    splits: tuple[str, ...] = ()

    def opened_by(self, out: Path) -> str:
        """What opens the export in the folder ``out``: some loaders ask for more than the layout does."""
        return self.about

    def missing(self, source: Source) -> list[Missing]:
        """What ``source`` lacks and its loaders cannot do without."""
        return [missing for need in self.needs if (missing := need(source)) is not None]

    def folder(self, source: Source) -> str:
        """Where its files go, below the export."""
        return f"{source.split}/{source.name}"

    def write(self, source: Source, folder: Path) -> list[str]:
        """Makes the files of ``source`` in ``folder``, which is there. Returns what a person should know of, a line
        each. Raises AssetError: a file of the sequence is damaged; OutputError."""
        raise NotImplementedError


def forward_flow(source: Source) -> Missing | None:
    """What nearly every layout asks for."""
    return None if source.flow_times("forward") else Missing("forward flow", "labels: {flow: [forward]}")


def images(source: Source) -> Missing | None:
    """Of the camera that makes the events."""
    return None if source.image_times else Missing("images", "labels: {images: true}")
