"""Dictionaries of values that are made when they are first asked for."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import TypeVar

_Key = TypeVar("_Key", bound=Hashable)
_Value = TypeVar("_Value")


class Kept(dict[_Key, _Value]):
    """Every value that was made."""

    def of(self, key: _Key, make: Callable[[], _Value]) -> _Value:
        """Return the value of this key: the kept one, or ``make()``."""
        if key not in self:
            self[key] = make()
        return self[key]


class Recent(Kept[_Key, _Value]):
    """The last ``most`` values that were made; the oldest is dropped first, and none is sent to another process."""

    def __init__(self, most: int):
        super().__init__()
        self.most = most

    def of(self, key: _Key, make: Callable[[], _Value]) -> _Value:
        """Return the value of this key: the kept one, or ``make()``."""
        value = super().of(key, make)
        # A dictionary keeps the order of insertion, so its first key is the oldest.
        if len(self) > self.most:
            del self[next(iter(self))]
        return value

    def __reduce__(self) -> tuple[type[Recent], tuple[int]]:
        return Recent, (self.most,)
