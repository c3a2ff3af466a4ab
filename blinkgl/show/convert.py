"""``blinkgl convert``: prints one line about the output, and one for each thing that was guessed or left out."""

from __future__ import annotations

from typing import Any

from blinkgl.errors import ConfigError
from blinkgl.io.formats import FORMATS, convert, output_format
from blinkgl.io.reading import EventReading
from blinkgl.machine.terminal import plain_console, say
from blinkgl.show.look import looked_at


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
