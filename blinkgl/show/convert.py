"""``blinkgl convert``: prints one line about the output, and one for each thing that was guessed or left out;
with --look what an event file states: its format, what is missing, the first rows, the options to declare the rest."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from blinkgl.errors import BlinkGLError, ConfigError
from blinkgl.io.formats import FORMATS, convert, open_events, output_format
from blinkgl.io.reading import AS_FILE, EventReading
from blinkgl.machine.terminal import plain_console, say


def run(source: str, target: str | None, *, reading: EventReading, look: bool = False, **options: Any) -> int:
    """``options``: of :func:`~blinkgl.io.formats.convert`.   look : print what the source states instead."""
    if look or target is None:
        if not look:
            raise ConfigError("no output", where="OUT", accepted="an event file, or --look to see what IN states")
        for line in looked_at(source, reading):
            say(plain_console(), line)
        return 0
    file, count = convert(source, target, reading, **options)
    size = f"{file.width}x{file.height}" if file.height else "no size in it (--size WIDTHxHEIGHT)"
    say(plain_console(), f"{target}: {count:,} events, {size}, from {file.format}")
    written = output_format(target)
    if file.causes and not FORMATS[written].causes:
        say(plain_console(), "the causes of the events are left out: the format cannot hold them")
    for line in file.notes:
        say(plain_console(stderr=True), f"{source}: {line}")
    if reading.time_unit and written in ("text", "csv") and options.get("write_unit") == "s":
        say(plain_console(stderr=True), "--time-unit is the unit of IN; --write-unit us writes OUT in µs")
    return 0


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
        yield from (text := list(_text(path)))
        # Arrays cannot be shown as they lie: their rows as the proposal has them tell whether it is right.
        proposed = re.search(r"try ((?:--columns (\S+) ?)?(?:--time-unit (\w+))?) if that is right", str(error))
        if proposed and not text:
            columns = tuple(proposed[2].split(",")) if proposed[2] else reading.columns
            unit = proposed[3] or reading.time_unit
            yield f"with {proposed[1]}:"
            yield from itertools.islice(looked_at(path, replace(reading, columns=columns, time_unit=unit)), 1, None)


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
