"""The tables that ship with the program, by name: sensors, rigs, quality presets, emulators' recipes."""

from __future__ import annotations

import copy
from functools import lru_cache
from importlib import resources
from typing import Any

from blinkgl.config.reader import parse_yaml


@lru_cache
def shipped_names(kind: str) -> tuple[str, ...]:
    """Names of all of a kind, a folder of ``blinkgl/configs``, sorted."""
    files = (resources.files("blinkgl.configs") / kind).iterdir()
    return tuple(sorted(file.name.removesuffix(".yaml") for file in files if file.name.endswith(".yaml")))


def shipped(kind: str, name: str) -> dict[str, Any]:
    """A copy of the table of this name, one of :func:`shipped_names`."""
    return copy.deepcopy(_read(kind, name))


@lru_cache
def _read(kind: str, name: str) -> dict[str, Any]:
    text = (resources.files("blinkgl.configs") / kind / f"{name}.yaml").read_text(encoding="utf-8")
    return parse_yaml(text, f"{kind}/{name}.yaml")
