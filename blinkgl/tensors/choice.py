"""The device of events: ``events.device: cpu | cuda | auto``. torch is imported only where a GPU is requested."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from blinkgl.config.events import EmulatorConfig
from blinkgl.events import Emulator, emulator_of, make_emulator

if TYPE_CHECKING:
    import torch

    from blinkgl.gl import GLContext


def make_on_device(
    config: EmulatorConfig,
    height: int,
    width: int,
    seed: int = 0,
    gl: GLContext | None = None,
) -> Emulator:
    """Return the emulator of a configuration, on its device.

    gl : context that draws the frames; ``auto`` is the GPU where one draws them, it supports the configuration, and its
    events equal the CPU's in a short trial.
    Raises EventDataError: ``events.device: cuda`` for an unsupported configuration, or without a GPU."""
    device = getattr(config, "device", "cpu")
    if device == "cpu" or (device == "auto" and (gl is None or gl.is_software)):
        return make_emulator(config, height, width, seed)
    from blinkgl.tensors.emulator import emulator_on

    return emulator_on(emulator_of(config), config, height, width, seed)


def on_device(array: np.ndarray, device: torch.device) -> torch.Tensor:
    """Return a tensor of the array's values on a torch device."""
    import torch

    return torch.from_numpy(array).to(device)
