"""The ``quality:`` key, which names a measured trade-off between speed and accuracy; see docs/trade.md."""

from __future__ import annotations

import json
from importlib import resources
from typing import Any, Literal, get_args

from blinkgl.config.reader import shipped
from blinkgl.types.trees import Tree

Quality = Literal["fast", "balanced", "accurate", "reference"]
QUALITIES: tuple[str, ...] = get_args(Quality)
DEFAULT: Quality = "balanced"
"""The preset of a configuration without the key; ``quality: null`` leaves every key at its own default."""


def with_default(tree: object) -> Any:
    """Return a configuration's plain data with ``quality`` filled in."""
    return {"quality": DEFAULT, **tree} if isinstance(tree, dict) else tree


def load_quality(name: str) -> Tree:
    """Return ``timeline:`` and ``render:`` of a preset as plain data; comments in its file give the figures it is based
    on."""
    return shipped("quality", name)


def measured_presets() -> Tree:
    """Return what the suite of ``trade`` measured: ``settings`` by name, and ``scenes`` with a row of costs and errors
    for each of them; a share, not a percentage. Made by ``tools/quality_presets.py``."""
    return json.loads((resources.files("blinkgl.configs") / "quality" / "measured.json").read_text(encoding="utf-8"))


def fill_quality(quality: object, kind: object) -> Tree:
    """Return the preset's values for a configuration with this timeline.kind (None: not given). Unknown presets have
    none. The preset's timeline values are left out for a timeline of another kind."""
    if quality not in QUALITIES:
        return {}
    preset = load_quality(quality)
    same = kind in (None, preset["timeline"]["kind"])
    return {"timeline": preset["timeline"] if same else {}, "render": preset["render"]}
