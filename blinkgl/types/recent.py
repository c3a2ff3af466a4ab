"""A dictionary of what was made last."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import TypeVar

_Key = TypeVar("_Key", bound=Hashable)
_Value = TypeVar("_Value")


class Recent(dict[_Key, _Value]):
    """The last ``most`` values that were made; the oldest is dropped first, and none is sent to another process."""

    def __init__(self, most: int):
        super().__init__()
        self.most = most

    def of(self, key: _Key, make: Callable[[], _Value]) -> _Value:
        """Return the value of this key: the kept one, or ``make()``."""
        if key not in self:
            self[key] = make()
            if len(self) > self.most:
                del self[next(iter(self))]
        return self[key]

    def __reduce__(self) -> tuple[type[Recent], tuple[int]]:
        return Recent, (self.most,)
