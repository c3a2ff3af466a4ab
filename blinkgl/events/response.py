"""How far an emulator's signal moves for a change of luminance: what the time sampling has to know about the sensor."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np


class Thresholds(Protocol):
    """Whatever has a contrast threshold and, where OFF differs, another."""

    contrast_threshold: float
    contrast_threshold_off: float | None


def smallest_threshold(config: Thresholds) -> float:
    """Of a configuration with ``contrast_threshold`` and ``contrast_threshold_off``."""
    return min(config.contrast_threshold, config.contrast_threshold_off or config.contrast_threshold)


class Response(NamedTuple):
    """The signal gain * ln(I + offset), below the luminance ``joint`` a straight line, which fires every ``threshold``
    (the smallest nominal one)."""

    threshold: float
    gain: float
    offset: float
    joint: float = 0.0
    low_slope: float = 0.0

    def signal(self, luminance: np.ndarray) -> np.ndarray:
        """float32."""
        # The logarithm above the joint; below it the logarithm stays, and the straight line adds what
        # is missing.
        joint = np.float32(self.joint)
        log = np.float32(self.gain) * np.log(np.maximum(luminance, joint) + np.float32(self.offset))
        return log + np.float32(self.low_slope) * np.minimum(luminance - joint, 0) if self.low_slope else log

    def change(self, luminance: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """d(signal)/dt of luminances and their rates of change, in the rates' unit of time."""
        slope = np.float32(self.gain) / (np.maximum(luminance, np.float32(self.joint)) + np.float32(self.offset))
        return rate * (np.where(luminance > self.joint, slope, np.float32(self.low_slope)) if self.low_slope else slope)
