"""Event emulators, independent of scenes and OpenGL.

In:    frames (linear luminance, float32) and times (int64 ns).
Out:   :class:`~blinkgl.types.events.Events`, columnar, in order of time.
Start: esim.py, the simplest; emulator.py is the interface, table.py lists all emulators.
"""

from __future__ import annotations

from importlib import import_module

from blinkgl.config.events import EmulatorConfig
from blinkgl.events.emulator import Emulator
from blinkgl.events.esim import Esim
from blinkgl.events.table import emulator_of, make_emulator, register
from blinkgl.events.v2e import V2e
from blinkgl.events.voltmeter import DvsVoltmeter
from blinkgl.types.events import Events

__all__ = ["DvsVoltmeter", "Emulator", "Esim", "Events", "V2e", "emulator_of", "make_emulator", "register"]

# Every kind that a configuration may name has a module of that name, which registers its class.
for _kind in tuple(EmulatorConfig.members):
    import_module(f"blinkgl.events.{_kind}")
