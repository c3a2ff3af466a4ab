"""``quality:`` names a point on the measured front of speed against accuracy; see docs/trade.md."""

from __future__ import annotations

import copy
from functools import lru_cache
from importlib import resources
from typing import Any, Literal

from blinkgl.config.events import EmulatorConfig, followers
from blinkgl.config.reader import parse_yaml

Quality = Literal["fast", "balanced", "accurate", "reference", "auto"]
QUALITIES = ("fast", "balanced", "accurate", "reference")
"""Those that are settings of the suite. ``auto`` is :data:`DEFAULT` with a first look at each sequence."""
DEFAULT: Quality = "balanced"
"""Of a configuration that says nothing; ``quality: null`` leaves every key at its own default."""


def with_default(tree: Any) -> Any:
    """A configuration's plain data with ``quality`` said."""
    return {"quality": DEFAULT, **tree} if isinstance(tree, dict) else tree


def load_quality(name: str) -> dict[str, Any]:
    """``timeline:`` and ``render:`` of a preset, plain data; the figures it was chosen by are comments in its file."""
    preset = copy.deepcopy(_shipped(DEFAULT if name == "auto" else name))
    if name == "auto":
        preset["timeline"]["first_look"] = True
    return preset


@lru_cache
def _shipped(name: str) -> dict[str, Any]:
    return parse_yaml(
        (resources.files("blinkgl.configs") / "quality" / f"{name}.yaml").read_text(encoding="utf-8"),
        f"quality/{name}.yaml",
    )


def fill_quality(quality: Any, kind: Any, emulator: Any, frames: Any, reconstruction: Any = None) -> dict[str, Any]:
    """The preset's values for a configuration with this timeline.kind, events.emulator, frames and
    timeline.reconstruction (None: not said); none where ``quality`` names no known one.

    A timeline of another kind than the preset's takes the preset's reconstruction alone: the other values mean nothing
    to it. A first look is at straight lines, and none is taken with others. Emulators that cannot follow the preset's
    reconstruction take everything but that."""
    if quality not in (*QUALITIES, "auto"):
        return {}
    preset = load_quality(quality)
    given = preset["timeline"]
    if reconstruction not in (None, "linear"):
        given.pop("first_look", None)
    if kind not in (None, given["kind"]):
        given = {key: value for key, value in given.items() if key == "reconstruction"}
    able = followers(given.get("reconstruction", "linear"))
    if (EmulatorConfig.members.default if emulator is None else emulator) not in able and frames is None:
        given = {key: value for key, value in given.items() if key != "reconstruction"}
    return {"timeline": given, "render": preset["render"]}
