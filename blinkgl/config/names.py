"""Names of the tables that ship with the program, for messages, descriptions and the help of commands."""

from __future__ import annotations

from functools import lru_cache
from importlib import resources


@lru_cache
def shipped_names(kind: str) -> tuple[str, ...]:
    """Return the sorted names of all tables of a kind, which is a folder of ``blinkgl/configs``."""
    files = (resources.files("blinkgl.configs") / kind).iterdir()
    return tuple(sorted(file.name.removesuffix(".yaml") for file in files if file.name.endswith(".yaml")))
