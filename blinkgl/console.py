"""Output on terminals and in pipes that cannot show every character."""

from __future__ import annotations

import codecs
import sys

_PLAIN = {"–": "-", "—": "-", "−": "-", "…": "...", "µ": "u", "μ": "u", "×": "x", "·": "*", "²": "^2", "³": "^3", "°": " deg", "≥": ">=", "≤": "<=",
          "→": "->", "±": "+-", "σ": "sigma", "‘": "'", "’": "'", "“": '"', "”": '"'}


def _plainly(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(_PLAIN.get(c, "?") for c in error.object[error.start:error.end]), error.end


def never_fail_to_print() -> None:
    """From here on, a character that stdout or stderr cannot encode (LC_ALL=C, PYTHONIOENCODING=ascii) is printed as the nearest plain
    one, or '?'. A command calls it before it prints anything; a number nobody can read is better than none."""
    codecs.register_error("blinkgl-plainly", _plainly)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # not what tests and notebooks put there
            stream.reconfigure(errors="blinkgl-plainly")
