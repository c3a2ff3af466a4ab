"""Event cameras: emulators for frames, and the values of the included sensors."""

from __future__ import annotations

from collections.abc import Mapping

from blinkgl.config.sensor import SensorConfig, load_sensor as _load_sensor
from blinkgl.events import Emulator
from blinkgl.events.emulator import MAX_SIDE
from blinkgl.front import arguments as check
from blinkgl.recordings.simulation import with_sensor
from blinkgl.tensors.choice import make_on_device

_STEP = """

    height, width : px.   seed : of its noise.   sensor : a camera whose values are the defaults, such as "davis346",
    or a sensor file.
    values : keys of ``events:`` (docs/configuration.md).

    Returns an emulator: ``emulator.step(luminance, t_ns)`` takes (H, W) float32 linear luminance, or uint8, at
    increasing int ns, and gives :class:`Events` since the step before, t in µs; the first step sets the reference.
    Raises ConfigError and, from ``step``, EventDataError."""


def _made(kind: str, height: int, width: int, seed: int, sensor: str | None, values: Mapping[str, object]) -> Emulator:
    height, width = check.whole(height, "height", 1, MAX_SIDE - 1), check.whole(width, "width", 1, MAX_SIDE - 1)
    config, _ = with_sensor({"emulator": kind, **check.plain(values)}, sensor)
    return make_on_device(config, height, width, check.seed(seed))


@check.public()
def Esim(height: int, width: int, *, seed: int = 0, sensor: str | None = None, **values: object) -> Emulator:
    return _made("esim", height, width, seed, sensor, values)


@check.public()
def V2e(height: int, width: int, *, seed: int = 0, sensor: str | None = None, **values: object) -> Emulator:
    return _made("v2e", height, width, seed, sensor, values)


@check.public()
def DvsVoltmeter(height: int, width: int, *, seed: int = 0, sensor: str | None = None, **values: object) -> Emulator:
    return _made("voltmeter", height, width, seed, sensor, values)


Esim.__doc__ = (
    "ESIM (Rebecq et al., CoRL 2018): an event at every crossing of a contrast threshold of the log intensity." + _STEP
)
V2e.__doc__ = "V2E (Hu et al., CVPRW 2021): finite bandwidth, mismatch, leak, shot noise, refractory period." + _STEP
DvsVoltmeter.__doc__ = (
    "DVS-Voltmeter (Lin et al., ECCV 2022): Brownian motion with drift between two thresholds." + _STEP
)


@check.public()
def load_sensor(name: str, unit: int | None = None) -> SensorConfig:
    """Return the values of an included camera, by its name in docs/sensors.md (case and punctuation do not matter), or
    of a sensor file by its path.

    ``width``, ``height`` (px), ``contrast_threshold`` (ln units), ``refractory_us`` (µs), ``readout`` …, None if the
    file does not contain it; ``values("v2e")`` gives an emulator's keys.
    unit : for values that are distributions over units: the number of the unit; None: the middle value. Raises
    ConfigError."""
    return _load_sensor(name, None if unit is None else check.whole(unit, "unit", 0, 2**31))
