"""Which of the networks that come with the package suits a recording: the one that reads two windows, unless there are
none."""

from __future__ import annotations

from collections.abc import Iterator

from blinkgl.io.formats import EventFile
from eflow import infer
from eflow.cli_arguments import WindowsAsked
from eflow.data.window import StreamWindow

AUTO = "auto"
ONE_WINDOW, TWO_WINDOWS = "real_small", "real_bodies"


def chosen(file: EventFile, asked: WindowsAsked) -> tuple[str, str]:
    """Return (name of a network, the line that says why). The one of two windows has less error on cameras and bodies
    alike, for few events and many (docs/results_eflow.md)."""
    if any(len(pair.old) and len(pair.new) for pair in _pairs(file, asked)):
        return TWO_WINDOWS, TWO_WINDOWS
    return ONE_WINDOW, f"{ONE_WINDOW}, since there is no pair of windows with events ({TWO_WINDOWS} needs two)"


def _pairs(file: EventFile, asked: WindowsAsked) -> Iterator[StreamWindow]:
    if asked.whole:
        yield infer.whole_file(file)[0]
        return
    if (ends := infer.ends_of(file)) is None:
        return
    first, last = asked.within(ends)
    # Of a length still to be found those that are looked at first: half of a long recording would fill the memory.
    yield from infer.at_places(file, asked.span_us or min(infer.FIRST_US, max((last + 1 - first) // 2, 1)), first, last)
