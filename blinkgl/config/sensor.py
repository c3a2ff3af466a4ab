"""Sensors: what a camera's data sheet and papers say, in a form the emulators can use."""

from __future__ import annotations

from importlib import resources
from typing import Any, Literal

import yaml
from pydantic import Field

from blinkgl.config.base import Config, validate
from blinkgl.config.events import EmulatorConfig, EsimConfig, V2eConfig, VoltmeterConfig
from blinkgl.errors import ConfigError


class ReadoutConfig(Config):
    """The bus between pixels and time stamps; see :mod:`blinkgl.events.readout`."""

    events_per_second: float = Field(gt=0, le=1e12, description="Peak rate of the bus, events per second.")
    row_ns: float = Field(0.0, ge=0, le=1e6, description="Time to open a row before its events go out, nanoseconds; 0: every "
                          "event is arbitrated by itself.")
    queue_events: int = Field(4096, ge=1, le=2**24, description="Events that may wait for the bus; one that finds the queue full "
                              "is lost.")


class SensorConfig(Config):
    """One camera. Thresholds are in ln units: a contrast of 15 % is ln 1.15 = 0.14."""

    name: str = Field(description="The camera's name.")
    width: int = Field(ge=1, le=65535, description="Columns, px.")
    height: int = Field(ge=1, le=65535, description="Rows, px.")
    pixel_pitch_um: float = Field(gt=0, le=1000, description="Distance between pixel centres, micrometres.")
    contrast_threshold: float = Field(ge=0.001, le=10, description="Nominal ON threshold, ln units.")
    contrast_threshold_off: float | None = Field(None, ge=0.001, le=10, description="Nominal OFF threshold; default: equal.")
    threshold_sigma: float = Field(0.0, ge=0, le=5, description="Spread of the threshold over the pixels, ln units.")
    cutoff_hz: float = Field(0.0, ge=0, le=1e7, description="Photoreceptor bandwidth in good light, Hz; 0: unlimited.")
    refractory_us: float = Field(0.0, ge=0, le=1e9, description="Dead time of a pixel, microseconds.")
    leak_rate_hz: float = Field(0.0, ge=0, le=1e4, description="Leak events per second and pixel.")
    shot_noise_rate_hz: float = Field(0.0, ge=0, le=1e4, description="Noise events per second and pixel in the dark.")
    voltmeter: Literal["DVS346", "DVS240"] = Field("DVS346", description="Nearest camera that DVS-Voltmeter was calibrated on.")
    readout: ReadoutConfig = Field(description="Read-out limit.")

    def emulator(self, emulator: str, **overrides: Any) -> EmulatorConfig:
        """Config of ``esim``, ``v2e`` or ``voltmeter`` with this sensor's values, ``overrides`` on top.

        For the Voltmeter k1 = 1 / threshold replaces the calibrated gain only where the sensor is not the
        calibrated camera itself. Raises ConfigError.
        """
        pixel = dict(contrast_threshold=self.contrast_threshold, contrast_threshold_off=self.contrast_threshold_off,
                     threshold_sigma=self.threshold_sigma, refractory_us=self.refractory_us)
        if emulator == "esim":
            return validate(EsimConfig, {**pixel, **overrides}, where="events")
        if emulator == "v2e":
            noise = dict(cutoff_hz=self.cutoff_hz, leak_rate_hz=self.leak_rate_hz, shot_noise_rate_hz=self.shot_noise_rate_hz)
            return validate(V2eConfig, {**pixel, **noise, **overrides}, where="events")
        if emulator == "voltmeter":
            calibrated = self.name in ("DAVIS346", "DAVIS240C")
            gain = {} if calibrated else dict(k1=1 / self.contrast_threshold)
            data = dict(preset=self.voltmeter, refractory_us=self.refractory_us, **gain)
            return validate(VoltmeterConfig, {**data, **overrides}, where="events")
        raise ConfigError("unknown emulator", where="events.emulator", value=emulator, accepted="one of esim, v2e, voltmeter")


def sensor_names() -> list[str]:
    """Names of the shipped sensors, as ``load_sensor`` takes them."""
    return sorted(f.name.removesuffix(".yaml") for f in (resources.files("blinkgl.configs") / "sensors").iterdir()
                  if f.name.endswith(".yaml"))


def load_sensor(name: str) -> SensorConfig:
    """A shipped sensor by name (case and punctuation do not matter). Raises ConfigError naming the known ones."""
    plain = lambda s: "".join(c for c in s.lower() if c.isalnum())
    for known in sensor_names():
        if plain(known) == plain(name):
            text = (resources.files("blinkgl.configs") / "sensors" / f"{known}.yaml").read_text(encoding="utf-8")
            return validate(SensorConfig, yaml.safe_load(text), where=f"sensors/{known}.yaml")
    raise ConfigError("unknown sensor", where="sensor", value=name, accepted="one of " + ", ".join(sensor_names()))
