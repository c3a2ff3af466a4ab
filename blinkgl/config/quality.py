"""``quality:`` names a point on the measured front of speed against accuracy; see docs/trade.md."""

from __future__ import annotations

from importlib import resources
from typing import Any, Literal

import yaml

Quality = Literal["fast", "balanced", "accurate", "reference"]
QUALITIES = ("fast", "balanced", "accurate", "reference")


def load_quality(name: str) -> dict[str, Any]:
    """``timeline:`` and ``render:`` of a preset, plain data; the figures it was chosen by are comments in its file."""
    return yaml.safe_load((resources.files("blinkgl.configs") / "quality" / f"{name}.yaml").read_text(encoding="utf-8"))


def with_quality(tree: dict[str, Any]) -> dict[str, Any]:
    """``tree`` with the preset's values where it says nothing; as it is when it names no (known) preset.

    A timeline of another kind than the preset's is kept, and takes the preset's reconstruction alone: the other values
    mean nothing to it. Emulators that follow straight lines alone take everything but the reconstruction."""
    if tree.get("quality") not in QUALITIES:
        return tree
    preset = load_quality(tree["quality"])
    mine = {key: tree.get(key) for key in ("timeline", "render")}
    if any(value is not None and not isinstance(value, dict) for value in mine.values()):
        return tree  # which is refused
    timeline, render = mine["timeline"] or {}, mine["render"] or {}
    given = preset["timeline"]
    if timeline.get("kind", given["kind"]) != given["kind"]:
        given = {key: value for key, value in given.items() if key == "reconstruction"}
    events = tree.get("events")
    if isinstance(events, dict) and events.get("emulator", "esim") != "esim" and tree.get("frames") is None:
        given = {key: value for key, value in given.items() if key != "reconstruction"}
    return {**tree, "timeline": {**given, **timeline}, "render": {**preset["render"], **render}}
