"""What is printed for people. Rich reads words in square brackets as its markup and drops them: "(extra [cluster])"
becomes "(extra )", a path "run[x]" loses its end. Every console and progress column of the project
is made here, and takes text as it stands.

And what is printed where not every character can be: :func:`never_fail_to_print`."""

from __future__ import annotations

import codecs
import os
import sys
from typing import Any

from rich.console import Console
from rich.progress import TextColumn

_NO_END = 10_000
"""Columns of a file."""


def plain_console(**options: Any) -> Console:
    """``rich.console.Console`` whose strings, in tables too, are no markup and no names of emoji (``a:bug:b`` is a
    folder). For style pass a ``rich.text.Text`` or ``style=``. Where nobody looks, in a pipe or a file, a line is as
    long as it is: whoever searches it shall find words whole."""
    console = Console(markup=False, emoji=False, **options)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = _NO_END
    return console


def say(console: Console, text: str) -> None:
    """One line as it stands: no colours for numbers, no line breaks of Rich's."""
    console.print(text, highlight=False, soft_wrap=True, markup=False)


def plain_column(text: str) -> TextColumn:
    """``rich.progress.TextColumn`` whose fields are no markup."""
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
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(_PLAIN.get(c, "?") for c in error.object[error.start : error.end]), error.end


def never_fail_to_print() -> None:
    """From here on, a character that stdout or stderr cannot encode (LC_ALL=C, PYTHONIOENCODING=ascii) is printed as
    the nearest plain one, or '?'. A command calls it before it prints anything; a number
    nobody can read is better than none."""
    codecs.register_error("blinkgl-plainly", _plainly)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # not what tests and notebooks put there
            stream.reconfigure(errors="blinkgl-plainly")


def causes_line(causes: dict[str, int], seconds: float) -> str:
    """Events by cause, in words: how many a second, and the share of all."""
    whole = max(sum(causes.values()), 1)
    parts = (f"{name} {n / max(seconds, 1e-9):,.4g}/s ({100 * n / whole:.1f} %)" for name, n in causes.items())
    return "by cause: " + ", ".join(parts)
