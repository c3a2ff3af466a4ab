"""What a configuration's time steps and filters are beside the default preset, and what leaving that one costs."""

from __future__ import annotations

import math
from typing import Any

from blinkgl.config.quality import DEFAULT, load_quality, measured
from blinkgl.config.sequence import RenderConfig, SequenceConfig
from blinkgl.config.timeline import DisplacementTimeline

COMPARED = {
    "timeline": (
        "kind",
        "reconstruction",
        "fps",
        "max_px",
        "percentile",
        "max_fraction_of_threshold",
        "max_time_error_us",
        "max_time_error_px",
    ),
    "render": ("antialiasing", "mip_bias", "anisotropy"),
}


def quality_in_words(config: SequenceConfig) -> str:
    """One line for ``explain``. Figures are means over the suite's scenes (docs/trade.md), where one of its settings is
    what the configuration asks for."""
    preset = load_quality(DEFAULT)
    usual = {
        "timeline": {**DisplacementTimeline().model_dump(), **preset["timeline"]},
        "render": {**RenderConfig().model_dump(), **preset["render"]},
    }
    mine = {"timeline": config.timeline.model_dump(), "render": config.render.model_dump()}
    if mine["timeline"]["kind"] != usual["timeline"]["kind"]:
        other = {"kind": mine["timeline"]["kind"], "reconstruction": mine["timeline"]["reconstruction"]}
        apart = [f"timeline: {other['kind']} (not {usual['timeline']['kind']})"]
        apart += _apart("timeline", {"reconstruction": other["reconstruction"]}, usual["timeline"])
    else:
        apart = _apart("timeline", mine["timeline"], usual["timeline"])
    apart += _apart("render", mine["render"], usual["render"])
    looks = mine["timeline"].get("first_look", False)
    looking = " with a first look: frames twice as far apart where a sequence hardly minds (docs/trade.md, auto)"
    if not apart:
        return f"{DEFAULT}{looking}" if looks else f"{DEFAULT}, the default"
    if looks:  # what it will see is not known here
        return f"not {DEFAULT}: {', '.join(apart)};{looking}"
    named = "" if config.quality in (None, DEFAULT) else f"{config.quality}; "
    return f"{named}not {DEFAULT}: {', '.join(apart)}: {_cost(mine, usual)}"


def _apart(table: str, mine: dict[str, Any], usual: dict[str, Any]) -> list[str]:
    return [
        f"{table}.{key} {_plain(mine[key])} (not {_plain(usual[key])})"
        for key in COMPARED[table]
        if key in mine and mine[key] != usual.get(key)
    ]


def _plain(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _cost(mine: dict[str, dict], usual: dict[str, dict]) -> str:
    names = {_key(meant): name for name, meant in measured()["settings"].items()}
    asked, default = names.get(_key(mine)), names.get(_key(usual))
    if asked is None or default is None:
        return "what that changes was not measured; `blinkgl trade` does for this scene"
    errors, costs = [], []
    for scene in measured()["scenes"].values():
        rows = {row["name"]: row for row in scene["settings"] if row["trusted"]}
        if asked in rows and default in rows:
            errors.append(rows[asked]["voxel"] / rows[default]["voxel"])
            costs.append(rows[asked][measured()["cost"]] / rows[default][measured()["cost"]])
    if not errors:
        return "no scene of the suite can tell what that changes"
    return (
        f"{_mean(errors):.2f} times its error ({min(errors):.2f} to {max(errors):.2f} in {len(errors)} scenes of the "
        f"suite) at {_mean(costs):.2f} times its cost"
    )


def _mean(values: list[float]) -> float:
    return math.exp(sum(math.log(v) for v in values) / len(values))


def _key(meant: dict[str, dict]) -> tuple:
    return tuple((table, key, meant[table].get(key)) for table, keys in COMPARED.items() for key in keys)
