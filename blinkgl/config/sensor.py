"""Sensors: what a camera's data sheet and papers say, in a form the emulators can use."""

from __future__ import annotations

from functools import lru_cache
from importlib import resources
from typing import Any

from pydantic import Field

from blinkgl.config.base import Config, Refused, rule, validate
from blinkgl.config.events import EmulatorConfig
from blinkgl.config.reader import parse_yaml
from blinkgl.errors import ConfigError


class ReadoutConfig(Config):
    """The bus between pixels and time stamps; see :mod:`blinkgl.events.readout`."""

    events_per_second: float = Field(ge=1, le=1e12, description="Peak rate of the bus, events per second.")
    row_ns: float = Field(
        0.0,
        ge=0,
        le=1e6,
        description="Time to open a row before its events go out, nanoseconds; 0: every event is arbitrated by itself.",
    )
    queue_events: int = Field(
        4096, ge=1, le=2**24, description="Events that may wait for the bus; one that finds the queue full is lost."
    )

    @rule("events_per_second", "row_ns", "queue_events")
    def _queue_empties(rate: float, row_ns: float, queue: int):
        if drain_us(rate, row_ns, queue) > 2**32:
            raise Refused(
                "the last event of a full queue would wait for more than an hour",
                where="queue_events",
                value=queue,
                accepted="a shorter queue or a faster bus",
            )

    @property
    def drain_us(self) -> float:
        """Longest that an event may be late, microseconds: the time that a full queue takes to empty."""
        return drain_us(self.events_per_second, self.row_ns, self.queue_events)


def drain_us(events_per_second: float, row_ns: float, queue_events: int) -> float:
    """Longest wait for a bus, microseconds (see :class:`ReadoutConfig`)."""
    return (queue_events + 1) * (1e6 / events_per_second + row_ns / 1000)


class SensorConfig(Config):
    """One camera. Thresholds are in ln units: a contrast of 15 % is ln 1.15 = 0.14."""

    name: str = Field(description="The camera's name.")
    width: int = Field(ge=1, le=65535, description="Columns, px.")
    height: int = Field(ge=1, le=65535, description="Rows, px.")
    pixel_pitch_um: float = Field(gt=0, le=1000, description="Distance between pixel centres, micrometres.")
    contrast_threshold: float = Field(ge=0.001, le=10, description="Nominal ON threshold, ln units.")
    contrast_threshold_off: float | None = Field(
        None, ge=0.001, le=10, description="Nominal OFF threshold; default: equal."
    )
    threshold_sigma: float = Field(0.0, ge=0, le=5, description="Spread of the threshold over the pixels, ln units.")
    cutoff_hz: float = Field(0.0, ge=0, le=1e7, description="Photoreceptor bandwidth in good light, Hz; 0: unlimited.")
    refractory_us: float = Field(0.0, ge=0, le=1e9, description="Dead time of a pixel, microseconds.")
    leak_rate_hz: float = Field(0.0, ge=0, le=1e4, description="Leak events per second and pixel.")
    shot_noise_rate_hz: float = Field(0.0, ge=0, le=1e4, description="Noise events per second and pixel in the dark.")
    calibrated: dict[str, str] = Field(
        {},
        description="Presets of emulators that were calibrated on this camera or, failing that, on the "
        "nearest one, by the emulator's name.",
    )
    readout: ReadoutConfig = Field(description="Read-out limit.")

    def values(self, emulator: Any) -> dict[str, Any]:
        """What this sensor says about the keys of the emulator of this name; of one that is not known nothing."""
        models = EmulatorConfig.members.models
        return models[emulator].from_sensor(self) if isinstance(emulator, str) and emulator in models else {}

    def emulator(self, emulator: str, **overrides: Any) -> EmulatorConfig:
        """Config of the emulator of this name with this sensor's values, ``overrides`` on top. Raises ConfigError."""
        models = EmulatorConfig.members.models
        if not isinstance(emulator, str) or emulator not in models:
            raise ConfigError(
                "unknown emulator", where="events.emulator", value=emulator, accepted="one of " + ", ".join(models)
            )
        return validate(models[emulator], {**self.values(emulator), **overrides}, where="events")


@lru_cache
def sensor_names() -> tuple[str, ...]:
    """Names of the shipped sensors, as ``load_sensor`` takes them."""
    return tuple(
        sorted(
            f.name.removesuffix(".yaml")
            for f in (resources.files("blinkgl.configs") / "sensors").iterdir()
            if f.name.endswith(".yaml")
        )
    )


def load_sensor(name: str) -> SensorConfig:
    """A shipped sensor by name (case and punctuation do not matter). Raises ConfigError naming the known ones."""
    known = known_sensor(name)
    if known is None:
        raise ConfigError("unknown sensor", where="sensor", value=name, accepted="one of " + ", ".join(sensor_names()))
    return _shipped(known)


def known_sensor(name: Any) -> str | None:
    """The name in :func:`sensor_names` that ``name`` means; None for one that is not shipped."""
    plain = lambda s: "".join(c for c in s.lower() if c.isalnum())
    return (
        next((known for known in sensor_names() if plain(known) == plain(name)), None)
        if isinstance(name, str)
        else None
    )


@lru_cache
def _shipped(known: str) -> SensorConfig:
    text = (resources.files("blinkgl.configs") / "sensors" / f"{known}.yaml").read_text(encoding="utf-8")
    return validate(SensorConfig, parse_yaml(text, f"sensors/{known}.yaml"), where=f"sensors/{known}.yaml")


def fill_sensor(sensor: Any, emulator: Any) -> dict[str, Any]:
    """What the sensor called ``sensor`` says about a configuration with ``emulator`` (None: the
    default one); nothing for an unknown one."""
    if known_sensor(sensor) is None:
        return {}
    camera = load_sensor(sensor)
    return {
        "camera": {"width": camera.width, "height": camera.height},
        "readout": camera.readout.model_dump(),
        "events": camera.values(EmulatorConfig.members.default if emulator is None else emulator),
    }
