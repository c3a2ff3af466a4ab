"""What a configuration's time steps and filters are beside the default preset."""

from __future__ import annotations

from typing import Any

from blinkgl.config.quality import DEFAULT, load_quality
from blinkgl.config.sequence import RenderConfig, SequenceConfig
from blinkgl.config.timeline import DisplacementTimeline

COMPARED = {
    "timeline": (
        "kind",
        "fps",
        "max_px",
        "percentile",
        "max_fraction_of_threshold",
    ),
    "render": ("antialiasing", "mip_bias", "anisotropy"),
}


def quality_in_words(config: SequenceConfig) -> str:
    """One line for ``explain``."""
    preset = load_quality(DEFAULT)
    usual = {
        "timeline": {**DisplacementTimeline().model_dump(), **preset["timeline"]},
        "render": {**RenderConfig().model_dump(), **preset["render"]},
    }
    mine = {"timeline": config.timeline.model_dump(), "render": config.render.model_dump()}
    kind, other = mine["timeline"]["kind"], usual["timeline"]["kind"]
    if kind != other:
        apart = [f"timeline: {kind} (not {other})"]
    else:
        apart = _apart("timeline", mine["timeline"], usual["timeline"])
    apart += _apart("render", mine["render"], usual["render"])
    looks = " with a first look (docs/trade.md, auto)" if mine["timeline"].get("first_look", False) else ""
    if not apart:
        return f"{DEFAULT}{looks or ', the default'}"
    named = "" if config.quality in (None, DEFAULT) else f"{config.quality}; "
    return f"{named}not {DEFAULT}: {', '.join(apart)}{looks}"


def _apart(table: str, mine: dict[str, Any], usual: dict[str, Any]) -> list[str]:
    return [
        f"{table}.{key} {_plain(mine[key])} (not {_plain(usual[key])})"
        for key in COMPARED[table]
        if key in mine and mine[key] != usual.get(key)
    ]


def _plain(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
