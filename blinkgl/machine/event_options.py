"""Options of commands that read event files: one name for one thing in convert, compare, calibrate and eflow predict.

Each is an argument of :meth:`blinkgl.io.reading.EventReading.of`."""

from __future__ import annotations

from typing import Annotated

import typer

TimeUnit = Annotated[
    str | None, typer.Option("--time-unit", help="Unit of t: s, ms, us or ns (default: as the file states).")
]
Origin = Annotated[str | None, typer.Option("--origin", help="Row of y = 0: top or bottom.")]
Columns = Annotated[
    str | None, typer.Option("--columns", help="Their order, e.g. x,y,t,p; _ ignores one, t=NAME names one.")
]
Polarity = Annotated[str | None, typer.Option("--polarity", metavar="OFF/ON", help="Their numbers, e.g. -1/1.")]
Stream = Annotated[
    str | None, typer.Option("--stream", "--array", help="One of several cameras, topics or arrays, by name or number.")
]
Damaged = Annotated[str, typer.Option("--damaged", help="refuse, or keep what is whole.")]
Sort = Annotated[bool, typer.Option("--sort", help="Put events in order.")]
