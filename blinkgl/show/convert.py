"""``blinkgl convert``: prints one line about the output."""

from __future__ import annotations

from typing import Any

from blinkgl.errors import ConfigError
from blinkgl.io.formats import WITH_CAUSES, convert, output_format
from blinkgl.machine.terminal import plain_console, say


def run(source: str, target: str, *, size: str | None = None, **options: Any) -> int:
    """``options``: of :func:`~blinkgl.io.formats.convert`. size : "WIDTHxHEIGHT"."""
    file, count = convert(source, target, size=size_of(size), **options)
    say(plain_console(), f"{target}: {count:,} events, {file.width}x{file.height}, from {file.format}")
    if file.causes and output_format(target) not in WITH_CAUSES:
        say(plain_console(), "the causes of the events are left out: the format cannot hold them")
    return 0


def size_of(text: str | None) -> tuple[int, int] | None:
    """Return (height, width) of the option ``--size``. Raises ConfigError."""
    if text is None:
        return None
    width, cross, height = text.lower().partition("x")
    if not (cross and width.isdigit() and height.isdigit() and 0 < int(width) <= 65536 and 0 < int(height) <= 65536):
        raise ConfigError("not a size", where="--size", value=text, accepted="WIDTHxHEIGHT, e.g. 640x480")
    return int(height), int(width)
