"""Tables of numbers in text, as programs write them: any separator, comments, a heading or none."""

from __future__ import annotations

import re

from blinkgl.types.numbers import is_number

_TITLE = re.compile(r"[^\s,;]+(?:\s*[\[(][^\])]*[\])])?")


def read_rows(text: str, most: int = 5_000_000) -> tuple[str, list[tuple[int, list[str]]]]:
    """Return the heading, the last comment or line without a number before the data, and (line, fields) of each line
    of data; fields are separated by blanks, tabs, commas or semicolons, and ``#`` begins a comment."""
    heading, rows = "", []
    for number, line in enumerate(text.splitlines()[:most], 1):
        body, _, comment = line.partition("#")
        fields = [part for part in re.split(r"[\s,;]+", body.strip()) if part]
        titled = comment.strip() if not fields else body.strip()
        if not fields or (not rows and not any(map(is_number, fields)) and (len(fields) > 1 or not heading)):
            heading = titled if titled and not rows else heading
        else:
            rows.append((number, fields))
    return heading, rows


def titles_of(heading: str) -> list[str]:
    """Return the titles of a heading's columns, units in brackets included."""
    return _TITLE.findall(heading)
