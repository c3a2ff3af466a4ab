"""How an emulator's signal depends on luminance: what time sampling needs to know about the sensor."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Response(NamedTuple):
    """The signal gain * ln(I + offset), below the luminance ``joint`` a straight line. An event is fired every
    ``threshold`` (the smallest nominal one)."""

    threshold: float
    gain: float
    offset: float
    joint: float = 0.0
    low_slope: float = 0.0

    def signal(self, luminance: np.ndarray) -> np.ndarray:
        """Return the signal, float32."""
        # Above the joint the logarithm; below it the logarithm at the joint plus the straight line.
        joint = np.float32(self.joint)
        log = np.float32(self.gain) * np.log(np.maximum(luminance, joint) + np.float32(self.offset))
        return log + np.float32(self.low_slope) * np.minimum(luminance - joint, 0) if self.low_slope else log

    def change(self, luminance: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Return d(signal)/dt of luminances and their rates of change, in the rates' unit of time."""
        slope = np.float32(self.gain) / (np.maximum(luminance, np.float32(self.joint)) + np.float32(self.offset))
        return rate * (np.where(luminance > self.joint, slope, np.float32(self.low_slope)) if self.low_slope else slope)
