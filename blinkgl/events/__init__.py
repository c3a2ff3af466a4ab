"""Event emulators: frames and times in, events out. They know nothing of scenes or OpenGL."""

from __future__ import annotations

from blinkgl.events.emulator import Emulator
from blinkgl.events.esim import Esim
from blinkgl.events.table import emulator_of, make_emulator, register
from blinkgl.events.types import Events
from blinkgl.events.v2e import V2e
from blinkgl.events.voltmeter import DvsVoltmeter

__all__ = ["DvsVoltmeter", "Emulator", "Esim", "Events", "V2e", "emulator_of", "make_emulator", "register"]

for _emulator in (Esim, V2e, DvsVoltmeter):
    register(_emulator)
