"""What an event file states, for people: its format, what is stated and what is missing, the first rows, and the
options to declare the rest."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from pathlib import Path

from blinkgl.errors import BlinkGLError
from blinkgl.io.formats import open_events
from blinkgl.io.reading import AS_FILE, EventReading

_ROWS, _WIDTH = 5, 100


def looked_at(path: str | os.PathLike, reading: EventReading = AS_FILE) -> Iterator[str]:
    """Yield lines about a file. What cannot be read without a declaration is one of them, and no error."""
    path = Path(path)
    kind = "a folder" if path.is_dir() else "no file"
    yield f"{path}: {path.stat().st_size:,} bytes" if path.is_file() else f"{path}: {kind}"
    try:
        with open_events(path, reading) as file:
            size = f"{file.width}x{file.height}" if file.height else "not stated (--size WIDTHxHEIGHT)"
            yield f"format {file.format}; size {size}"
            first = next(file.chunks(), None)
            if first is None:
                yield "no events"
            else:
                yield "t[us] x y p"
                rows = zip(*(getattr(first, k)[:_ROWS].tolist() for k in "txyp"))
                yield from (" ".join(map(str, row)) for row in rows)
            yield from file.notes
    except BlinkGLError as error:
        yield f"missing: {error}"
        yield from _text(path)


def _text(path: Path) -> Iterator[str]:
    """Yield the first lines of a file, if it is text."""
    if not path.is_file():
        return
    with open(path, "rb") as file:
        lines = list(itertools.islice(file, _ROWS))
    for line in lines:
        text = line[:_WIDTH].decode("utf-8", "replace").rstrip("\r\n")
        if not text.isprintable() or "\N{REPLACEMENT CHARACTER}" in text:
            return
        yield f"  {text}"
