"""Event emulators: frames and times in, events out. They know nothing of scenes or OpenGL."""

from __future__ import annotations

from blinkgl.config.events import EsimConfig, V2eConfig, VoltmeterConfig
from blinkgl.events.emulator import Emulator
from blinkgl.events.esim import Esim
from blinkgl.events.types import Events
from blinkgl.events.v2e import V2e
from blinkgl.events.voltmeter import DvsVoltmeter

__all__ = ["DvsVoltmeter", "Emulator", "Esim", "Events", "V2e", "make_emulator"]


def make_emulator(config, height: int, width: int, seed: int = 0, reconstruction: str = "linear") -> Emulator:
    """The emulator a config asks for: ``EsimConfig``, ``V2eConfig`` or ``VoltmeterConfig``; ``reconstruction``: its path
    between frames, see :class:`Emulator`."""
    for kind, model in ((EsimConfig, Esim), (V2eConfig, V2e), (VoltmeterConfig, DvsVoltmeter)):
        if isinstance(config, kind):
            return model(height, width, config, seed, reconstruction)
    raise TypeError(f"no emulator for {type(config).__name__}")
