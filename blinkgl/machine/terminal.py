"""Consoles and progress columns for text as it is. Rich interprets words in square brackets as markup and drops them:
"(extra [cluster])" becomes "(extra )". Every console and progress column of the project is made here.

Also printing where not every character can be encoded: :func:`never_fail_to_print`."""

from __future__ import annotations

import codecs
import os
import sys
from typing import Any

from rich.console import Console
from rich.progress import TextColumn
from rich.text import Text

from blinkgl.errors import printable
from blinkgl.machine.heartbeat import heartbeat

_NO_END = 10_000
"""Columns of a file."""


class _Console(Console):
    """A console that shows text of files as text: it escapes what a terminal would obey."""

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(printable(text, "\n\t"), **options)


def plain_console(**options: Any) -> Console:
    """Return a ``rich.console.Console`` that interprets no markup, no names of emoji (``a:bug:b`` is a folder) and no
    control characters, in tables too. For style pass a ``rich.text.Text`` or ``style=``. In a pipe or a file, lines are
    not wrapped, so that words can be searched."""
    console = _Console(markup=False, emoji=False, **options)
    # A file or a pipe has no width: rich would wrap lines at 80 columns, which a script would have to join.
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = _NO_END
    return console


def say(console: Console, text: str) -> None:
    """Print one line unchanged: no colours for numbers, no line breaks of Rich's."""
    heartbeat.heard()
    console.print(text, highlight=False, soft_wrap=True, markup=False)


def plain_column(text: str) -> TextColumn:
    """Return a ``rich.progress.TextColumn`` whose fields are not markup."""
    return TextColumn(text, markup=False)


_PLAIN = {
    "–": "-",
    "—": "-",
    "−": "-",
    "…": "...",
    "µ": "u",
    "μ": "u",
    "×": "x",
    "·": "*",
    "²": "^2",
    "³": "^3",
    "°": " deg",
    "≥": ">=",
    "≤": "<=",
    "→": "->",
    "±": "+-",
    "σ": "sigma",
    "‘": "'",
    "’": "'",
    "“": '"',
    "”": '"',
}


def _plainly(error: UnicodeError) -> tuple[str, int]:
    # Bytes that cannot be decoded stay an error.
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(_PLAIN.get(c, "?") for c in error.object[error.start : error.end]), error.end


def never_fail_to_print() -> None:
    """Print a character that stdout or stderr cannot encode (LC_ALL=C, PYTHONIOENCODING=ascii) as the nearest plain
    one, or '?', from here on. A command calls it before it prints anything."""
    codecs.register_error("blinkgl-plainly", _plainly)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # not what tests and notebooks put there
            stream.reconfigure(errors="blinkgl-plainly")


def causes_line(causes: dict[str, int], seconds: float) -> str:
    """Return events by cause, in words: events per second, and the share of all."""
    whole = max(sum(causes.values()), 1)
    parts = (f"{name} {n / max(seconds, 1e-9):,.4g}/s ({100 * n / whole:.1f} %)" for name, n in causes.items())
    return "by cause: " + ", ".join(parts)


def clock(seconds: float) -> str:
    """Return "1:02:03"."""
    return f"{int(seconds // 3600)}:{int(seconds // 60) % 60:02d}:{int(seconds) % 60:02d}"


def size(count: float) -> str:
    """Return a number of bytes as "0.21 GB", "35.2 MB" or "4 kB"."""
    unit, name = (1e9, "GB") if count >= 1e8 else (1e6, "MB") if count >= 1e5 else (1e3, "kB")
    return f"{count / unit:.{0 if unit < 1e6 else 1 if unit < 1e9 else 2}f} {name}"
