"""Where events are made: ``events.device: cpu | cuda | auto``. torch is imported where a card is asked for."""

from __future__ import annotations

from typing import TYPE_CHECKING

from blinkgl.config.events import EmulatorConfig
from blinkgl.events import Emulator, emulator_of, make_emulator

if TYPE_CHECKING:
    from blinkgl.gl import GLContext


def make_on_device(
    config: EmulatorConfig,
    height: int,
    width: int,
    seed: int = 0,
    gl: GLContext | None = None,
) -> Emulator:
    """Return the emulator that a configuration asks for, on the device that it asks for.

    gl : context that draws the frames; ``auto`` is the card where one draws them, its events are the processor's in a
    short trial, and it makes what is asked for.
    Raises EventDataError: ``events.device: cuda`` for what torch does not make, or without a card."""
    device = getattr(config, "device", "cpu")
    if device == "cpu" or (device == "auto" and (gl is None or gl.is_software)):
        return make_emulator(config, height, width, seed)
    from blinkgl.tensors.emulator import emulator_on

    return emulator_on(emulator_of(config), config, height, width, seed)
