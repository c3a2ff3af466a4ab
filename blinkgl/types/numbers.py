"""The one place where text of files becomes numbers: their length and size are limited before anything is computed."""

from __future__ import annotations

import re
from fractions import Fraction

_NUMBER = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]{1,3})?")
# Characters of a number, and its size: squares and cubes of it are finite, too.
_LONGEST, _LARGEST = 100, 1e100


def is_number(text: str) -> bool:
    """Return whether a text is a number that can be computed with: at most 100 characters, below 1e100."""
    return len(text) <= _LONGEST and _NUMBER.fullmatch(text) is not None and abs(float(text)) < _LARGEST


def exact(text: str) -> Fraction:
    """Return the number that a text states, exactly. Raises ValueError unless :func:`is_number`."""
    if not is_number(text):
        raise ValueError(f"{text[:40]} is no number below 1e100")
    return Fraction(text)
