"""``labels:``: which ground truth is written. Rows of :mod:`blinkgl.labels` say what each is; a label that is added
while the program runs, and has no key here, gets one of its own."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from blinkgl.config.base import Growing, Refused
from blinkgl.config.events import EmulatorConfig

_ACCEPTED = (
    "forward, backward, or an interval in s: a number or a fraction such as 1/100, from 1e-6 to 4300, negative: back"
)


def _where_to(value: Any) -> str | float:
    """An entry of ``labels.flow``: a direction, or seconds, which may be written as a fraction. Raises Refused."""
    if isinstance(value, str) and value in ("forward", "backward"):
        return value
    # No Fraction: that of "1e999999999" is a number of as many digits, and takes hours.
    top, slash, bottom = value.partition("/") if isinstance(value, str) else (value, "", "1")
    try:
        seconds = math.nan if isinstance(value, bool) else float(top) / float(bottom if slash else 1)
    except (ValueError, TypeError, ZeroDivisionError, OverflowError):
        seconds = math.nan
    if not 1e-6 <= abs(seconds) <= 4300:
        raise Refused("no direction, and no interval", value=value, accepted=_ACCEPTED)
    return seconds


def _each_once(flow: tuple[str | float, ...]) -> tuple[str | float, ...]:
    """Raises Refused for an interval that is there twice."""
    known: set[int] = set()
    for one in (one for one in flow if isinstance(one, float)):
        if round(one * 1e6) in known:
            raise Refused("an interval twice", value=one, accepted="each once")
        known.add(round(one * 1e6))
    return flow


def _a_table(value: Any) -> Any:
    """One message for what is neither of the two, instead of one for each."""
    if isinstance(value, bool):
        return value
    if not isinstance(value, dict):
        raise Refused(
            "no table of patterns", value=value, accepted="a table such as {'chair*': 7, '*': 0}, or true or false"
        )
    for pattern, number in value.items():
        if not isinstance(pattern, str) or not 1 <= len(pattern) <= 200:
            raise Refused("not a pattern of names", value=pattern, accepted="text of 1 to 200 characters")
        if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number <= 65535:
            raise Refused(f"no number of a category for '{pattern}'", value=number, accepted="0 to 65535")
    return value


class LabelsConfig(Growing):
    """What is written at label times. A pass that nobody asks for is not compiled, allocated or run.

    settings : keys that are no label's name."""

    settings: ClassVar[Any] = ("events", "pixels", "flow", "float_flow", "occlusion")
    events: bool = Field(
        False,
        description="what made each event: instance, depth and image velocity of the surface, and the cause "
        "(`events.causes` is then true unless that is said), in event_labels.h5, a row per event; docs/formats.md",
    )
    pixels: Literal["sensor", "rectified"] = Field(
        "sensor",
        description="of a lens that distorts: whether labels at label times and tracks are in the sensor's own pixels, "
        "as the events are, or in those of the rectified pin-hole picture (docs/cameras.md)",
    )
    images: bool = Field(True, description="sRGB PNG of the colour pass")
    flow: Annotated[
        tuple[Annotated[Literal["forward", "backward"] | float, BeforeValidator(_where_to)], ...],
        AfterValidator(_each_once),
    ] = Field(
        ("forward",),
        max_length=1000,
        description="optical flow: forward to the next label and backward to the one before, DSEC 16-bit PNG; numbers "
        "are intervals of one's own, s, from each label's time on (`0.01`, `1/30`; negative: back), float32 .h5 "
        "(docs/over_time.md)",
    )
    float_flow: tuple[Literal["npy", "flo"], ...] = Field((), description="float32 flow besides the PNG")
    occlusion: bool = Field(True, description="masks of pixels that are not visible at the flow's other end")
    depth: bool = Field(False, description="float32 .npy, world units along the optical axis")
    disparity: bool = Field(
        False,
        description="float32 .npy, px: x in the left eye less x in the right of a stereo pair, 0 where nothing is hit "
        "(docs/rigs.md)",
    )
    ids: bool = Field(False, description="instance ids, 16-bit PNG")
    normals: bool = Field(False, description="unit normals in camera axes, float32 .npy")
    velocity: bool = Field(False, description="instantaneous image velocity, px/s, float32 .npy")
    scene_flow: bool = Field(
        False,
        description="3-D motion of the surface to the next label, world units in the camera's axes at the label's "
        "time, 0 for what stands still, float32 .npy",
    )
    semantics: Annotated[bool | dict[str, int], BeforeValidator(_a_table)] = Field(
        False,
        description='category of what is seen, 16-bit PNG: a table of patterns, `{"wall-*": 1, "chair*": 7, "*": 0}`, '
        "the first that fits an object's name, its meshes' or its category counts, 0 where none does; true: by kind of "
        "shape, sky 1, ground 2, wall 3, cuboid 4 … (docs/boxes.md)",
    )
    boxes: bool = Field(
        False,
        description="boxes of objects, in the picture (visible, whole) and in space, .npz and KITTI's text "
        "(docs/boxes.md)",
    )


def fill_causes(events: bool | None, emulator: str | None) -> dict[str, Any]:
    """Whose truth is asked for say their causes, too, where their emulator knows them."""
    name = EmulatorConfig.members.default if emulator is None else emulator
    model = EmulatorConfig.members.models.get(name) if isinstance(name, str) else None
    return {"events": {"causes": True}} if events is True and model and "causes" in model.model_fields else {}
