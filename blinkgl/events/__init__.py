"""Event emulators: frames and times in, events out. They know nothing of scenes or OpenGL."""

from __future__ import annotations

from blinkgl.config.events import EsimConfig, V2eConfig, VoltmeterConfig
from blinkgl.events.emulator import Emulator
from blinkgl.events.esim import Esim
from blinkgl.events.types import Events
from blinkgl.events.v2e import V2e
from blinkgl.events.voltmeter import DvsVoltmeter

__all__ = ["DvsVoltmeter", "Emulator", "Esim", "Events", "V2e", "make_emulator"]


def make_emulator(config, height: int, width: int, seed: int = 0) -> Emulator:
    """The emulator a config asks for: ``EsimConfig``, ``V2eConfig`` or ``VoltmeterConfig``."""
    if isinstance(config, EsimConfig):
        return Esim(height, width, config, seed)
    if isinstance(config, V2eConfig):
        return V2e(height, width, config, seed)
    if isinstance(config, VoltmeterConfig):
        return DvsVoltmeter(height, width, config, seed)
    raise TypeError(f"no emulator for {type(config).__name__}")
