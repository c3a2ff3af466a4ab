"""``labels:``, whose keys come from the table of labels (:mod:`blinkgl.labels`): a label that is
registered has its key here from then on. What is no picture of a label's time has its key here from the beginning."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from blinkgl.config.base import Growing
from blinkgl.config.events import EmulatorConfig


class LabelsConfig(Growing):
    """What is written at label times. A pass that nobody asks for is not compiled, allocated or run."""

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


def fill_causes(events: bool | None, emulator: str | None) -> dict[str, Any]:
    """Whose truth is asked for say their causes, too, where their emulator knows them."""
    name = EmulatorConfig.members.default if emulator is None else emulator
    model = EmulatorConfig.members.models.get(name) if isinstance(name, str) else None
    return {"events": {"causes": True}} if events is True and model and "causes" in model.model_fields else {}
