"""Options of commands that read event files: one name for one thing in convert, compare, calibrate and eflow predict.

Each is an argument of :meth:`blinkgl.io.reading.EventReading.of`."""

from __future__ import annotations

from typing import Annotated

import typer

TimeUnit = Annotated[
    str | None,
    typer.Option("--time-unit", help="Unit of the times read: s, ms, us or ns (default: the file's; guessed)."),
]
Origin = Annotated[str | None, typer.Option("--origin", help="Row of y = 0: top or bottom (default: the format's).")]
Columns = Annotated[
    str | None,
    typer.Option("--columns", help="Order of a table's columns: x,y,t,p, _ for others; or names: x=col,t=stamp."),
]
Polarity = Annotated[str | None, typer.Option("--polarity", metavar="OFF/ON", help="Numbers of OFF and ON, e.g. -1/1.")]
Stream = Annotated[int | None, typer.Option("--stream", help="Number of one of several streams of events.")]
Damaged = Annotated[str, typer.Option("--damaged", help="refuse, or keep what is whole of a damaged file.")]
Sort = Annotated[bool, typer.Option("--sort", help="Put events in order of time (in memory).")]
