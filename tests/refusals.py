"""The line in which something is refused."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from blinkgl.errors import ConfigError


def refusal(call: Callable[..., object], *arguments: object, **keys: object) -> str:
    """Return what the ConfigError of a call says, in one line."""
    with pytest.raises(ConfigError) as caught:
        call(*arguments, **keys)
    assert "\n" not in str(caught.value)
    return str(caught.value)
