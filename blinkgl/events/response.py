"""How far an emulator's signal moves for a change of luminance: what the time sampling has to know about the sensor."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blinkgl.config.events import EsimConfig, V2eConfig


class Response(NamedTuple):
    """The signal gain * ln(I + offset), linear below I + offset = ``floor``, which fires every ``threshold`` (the smallest nominal one)."""

    threshold: float
    gain: float
    offset: float
    floor: float

    def signal(self, luminance: np.ndarray) -> np.ndarray:
        """float32."""
        above = np.maximum(luminance + np.float32(self.offset), np.float32(self.floor))
        return np.float32(self.gain) * (np.log(above) + (luminance + np.float32(self.offset) - above) / np.float32(self.floor))

    def change(self, luminance: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """d(signal)/dt of luminances and their rates of change, in the rates' unit of time."""
        return rate * (np.float32(self.gain) / np.maximum(luminance + np.float32(self.offset), np.float32(self.floor)))


def response_of(config) -> Response:
    """Of ``EsimConfig``, ``V2eConfig`` or ``VoltmeterConfig``."""
    if isinstance(config, EsimConfig):
        return Response(_smallest(config), 1.0, config.log_eps, 1e-30)
    if isinstance(config, V2eConfig):  # lin-log: linear below 20 digital numbers
        return Response(_smallest(config), 1.0, 0.0, 20.0 / np.log(20.0) / config.full_scale)
    return Response(1.0, config.k1, config.k2 / config.full_scale, 1e-30)


def _smallest(config) -> float:
    return min(config.contrast_threshold, config.contrast_threshold_off or config.contrast_threshold)
