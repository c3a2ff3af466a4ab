"""What a camera records beside its events: frames of its own and the samples of an inertial measurement unit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

G = 9.80665
"""m/s²; what recordings count in."""


@dataclass(frozen=True, eq=False)
class CameraFrame:
    """image : (H, W) or (H, W, 3) RGB, uint8 or uint16, row 0 at the top. begin_us, end_us : int, of the exposure, on
    the events' clock; the same where the file does not tell them apart."""

    image: np.ndarray
    begin_us: int
    end_us: int

    @property
    def t_us(self) -> int:
        """The middle of the exposure."""
        return (self.begin_us + self.end_us) // 2


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """t : (N,) int64 µs, on the events' clock, non-decreasing. acceleration : (N, 3) float64 m/s². rate : (N, 3)
    float64 rad/s. temperature : (N,) float64 °C. Axes are those of the unit, as the file has them."""

    t: np.ndarray
    acceleration: np.ndarray
    rate: np.ndarray
    temperature: np.ndarray

    def __len__(self) -> int:
        return len(self.t)
