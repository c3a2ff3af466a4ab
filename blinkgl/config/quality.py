"""``quality:`` names a point on the measured front of speed against accuracy; see docs/trade.md."""

from __future__ import annotations

from typing import Any, Literal

from blinkgl.config.reader import shipped

Quality = Literal["fast", "balanced", "accurate", "reference"]
QUALITIES = ("fast", "balanced", "accurate", "reference")
DEFAULT: Quality = "balanced"
"""Of a configuration that says nothing; ``quality: null`` leaves every key at its own default."""


def with_default(tree: Any) -> Any:
    """A configuration's plain data with ``quality`` said."""
    return {"quality": DEFAULT, **tree} if isinstance(tree, dict) else tree


def load_quality(name: str) -> dict[str, Any]:
    """``timeline:`` and ``render:`` of a preset, plain data; the figures it was chosen by are comments in its file."""
    return shipped("quality", name)


def fill_quality(quality: Any, kind: Any) -> dict[str, Any]:
    """The preset's values for a configuration with this timeline.kind (None: not said); none where ``quality`` names
    no known one. To a timeline of another kind than the preset's its values mean nothing."""
    if quality not in QUALITIES:
        return {}
    preset = load_quality(quality)
    same = kind in (None, preset["timeline"]["kind"])
    return {"timeline": preset["timeline"] if same else {}, "render": preset["render"]}
