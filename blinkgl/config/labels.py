"""The ``labels:`` section: which ground truth is written. The rows of :mod:`blinkgl.labels` define each label; a label
that is added at run time and has no key here gets one."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from blinkgl.config.base import Config, Refused
from blinkgl.config.events import EmulatorConfig
from blinkgl.config.problems import nearest

_ACCEPTED = (
    "forward, backward, or an interval in s: a number or a fraction such as 1/100, from 1e-6 to 4300, negative: back"
)


def _where_to(value: Any) -> str | float:
    """Return an entry of ``labels.flow``: a direction, or an interval in s, which may be written as a fraction. Raises
    Refused."""
    if isinstance(value, str) and value in ("forward", "backward"):
        return value
    # Not Fraction: for "1e999999999" it builds a number of as many digits, which takes hours.
    top, slash, bottom = value.partition("/") if isinstance(value, str) else (value, "", "1")
    try:
        seconds = math.nan if isinstance(value, bool) else float(top) / float(bottom if slash else 1)
    except (ValueError, TypeError, ZeroDivisionError, OverflowError):
        seconds = math.nan
    if not 1e-6 <= abs(seconds) <= 4300:
        raise Refused("not a direction or an interval", value=value, accepted=_ACCEPTED)
    return seconds


def _each_once(flow: tuple[str | float, ...]) -> tuple[str | float, ...]:
    """Return the entries. Raises Refused for an interval that is given twice."""
    known: set[int] = set()
    for one in (one for one in flow if isinstance(one, float)):
        if round(one * 1e6) in known:
            raise Refused("an interval is given twice", value=one, accepted="each once")
        known.add(round(one * 1e6))
    return flow


def _a_table(value: object) -> object:
    """Check a table of patterns, so that a wrong value gives one message instead of one per member of the union."""
    if isinstance(value, bool):
        return value
    if not isinstance(value, dict):
        raise Refused(
            "not a table of patterns", value=value, accepted="a table such as {'chair*': 7, '*': 0}, or true or false"
        )
    for pattern, number in value.items():
        if not isinstance(pattern, str) or not 1 <= len(pattern) <= 200:
            raise Refused("not a pattern of names", value=pattern, accepted="text of 1 to 200 characters")
        if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number <= 65535:
            raise Refused(f"not a category number for '{pattern}'", value=number, accepted="0 to 65535")
    return value


class LabelsConfig(Config, extra="allow"):
    """Ground truth at label times."""

    settings: ClassVar[Any] = ("events", "pixels", "flow", "float_flow", "occlusion")
    """Keys that do not name a label."""
    added: ClassVar[list[str]] = []
    """Keys of the labels of plug-ins, true or false."""

    @model_validator(mode="before")
    @classmethod
    def _with_added(cls, data: object) -> object:
        """Return the keys with those of plug-ins, false unless they are given. Raises Refused for an unknown key."""
        if not isinstance(data, dict):
            return data
        known = {*cls.model_fields, *cls.added}
        for key, value in data.items():
            if isinstance(key, str) and key not in known:
                raise Refused("unknown key", where=key, accepted=nearest(key, sorted(known)))
            if key in cls.added and not isinstance(value, bool):
                raise Refused("not true or false", where=key, value=value, accepted="true or false")
        return {**dict.fromkeys(cls.added, False), **data}

    events: bool = Field(
        False,
        description="what made each event, in event_labels.h5 (docs/labels.md); sets `events.causes` unless it is "
        "given",
    )
    pixels: Literal["sensor", "rectified"] = Field(
        "sensor",
        description="of labels and tracks behind a lens: the sensor's, as of events, or those of the rectified image "
        "(docs/cameras.md)",
    )
    images: bool = Field(True, description="sRGB PNG of the colour pass")
    flow: Annotated[
        tuple[Annotated[Literal["forward", "backward"] | float, BeforeValidator(_where_to)], ...],
        AfterValidator(_each_once),
    ] = Field(
        ("forward",),
        max_length=1000,
        description="forward to the next label and backward to the previous one, DSEC 16-bit PNG; numbers: other "
        "intervals, s (docs/labels.md)",
    )
    float_flow: tuple[Literal["npy", "flo"], ...] = Field((), description="float32 flow in addition to the PNG")
    occlusion: bool = Field(True, description="pixels that are not visible at the other end of the flow")
    depth: bool = Field(False, description="float32 .npy, world units along the optical axis")
    disparity: bool = Field(
        False,
        description="of a stereo pair, px, float32 .npy (docs/rigs.md)",
    )
    ids: bool = Field(False, description="instance ids, 16-bit PNG")
    normals: bool = Field(False, description="unit normals in camera axes, float32 .npy")
    velocity: bool = Field(False, description="instantaneous image velocity, px/s, float32 .npy")
    scene_flow: bool = Field(
        False,
        description="3-D motion of the surface to the next label, float32 .npy (docs/labels.md)",
    )
    semantics: Annotated[bool | dict[str, int], BeforeValidator(_a_table)] = Field(
        False,
        description="category of each pixel, 16-bit PNG: true, or a table of patterns (docs/labels.md)",
    )
    boxes: bool = Field(
        False,
        description="boxes of objects, in the image and in 3-D, .npz and KITTI's text (docs/labels.md)",
    )


def fill_causes(events: bool | None, emulator: str | None) -> dict[str, object]:
    """Return ``causes: true`` for emulators that know their events' causes where ``labels.events`` is on."""
    name = EmulatorConfig.default_member if emulator is None else emulator
    model = EmulatorConfig.members.get(name) if isinstance(name, str) else None
    return {"events": {"causes": True}} if events is True and model and "causes" in model.model_fields else {}
