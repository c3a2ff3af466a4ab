"""What is refused, and how it is said: in one line."""

from __future__ import annotations

from collections.abc import Callable

import pytest


def refusal(
    error: type[Exception] | tuple[type[Exception], ...], call: Callable, *args, match: str | None = None, **options
) -> str:
    """The message with which a call is refused, of one line.   match : a pattern that is in it."""
    with pytest.raises(error, match=match) as caught:
        call(*args, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)
