"""Exposure times of pixels, and the instants that an image averages.

Row r collects light over [start + r * row, start + r * row + exposure). The time from the first row's start to the last
row's end is divided into n equal cells; each is drawn once, at its middle, and a row weights it by the part of the cell
inside its own exposure: the midpoint rule, the same for a global and a rolling shutter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from blinkgl.config.images import NS_PER_US, AutoExposureConfig
from blinkgl.machine.kernels import kernel


@dataclass(frozen=True)
class Exposure:
    """The exposure of an image. start_ns : of the first row.   exposure_ns : of every row.   row_ns : delay of each row
    after the one above (0: global shutter).   rows : of the image."""

    start_ns: int
    exposure_ns: int
    row_ns: float
    rows: int

    @property
    def end_ns(self) -> int:
        """Return the end of the last row's exposure."""
        return self.start_ns + self.exposure_ns + round((self.rows - 1) * self.row_ns)

    @property
    def middle_ns(self) -> int:
        """Return the middle of the image's exposure: that of the middle row."""
        return (self.start_ns + self.end_ns) // 2

    def cells(self, count: int) -> tuple[list[tuple[int, int, int]], np.ndarray]:
        """Return the begin, middle and end, ns, of ``count`` instants, and (count, rows) float64 weights: each row's
        sum to 1."""
        span = float(self.end_ns - self.start_ns)
        edges = np.linspace(0.0, span, count + 1)
        cells = np.stack([edges[:-1], (edges[1:] + edges[:-1]) / 2, edges[1:]], axis=1)
        times = [
            (begin, middle, end) for begin, middle, end in (self.start_ns + np.floor(cells).astype(np.int64)).tolist()
        ]
        # begins: when each row's exposure starts; the last row's ends with the span.
        begins = np.linspace(0.0, span - self.exposure_ns, self.rows) if self.rows > 1 else np.zeros(1)
        # overlap: the time that cell and exposure have in common, (count, rows); below 0 where they do not meet.
        overlap = np.minimum(edges[1:, None], begins + self.exposure_ns) - np.maximum(edges[:-1, None], begins)
        weights = np.maximum(overlap, 0.0)
        return times, weights / weights.sum(axis=0)


def instants(exposure: Exposure, speed: float, max_px: float, lens: int, most: int, changes: float = 0.0) -> int:
    """Return the number of instants of an image: enough that nothing moves farther than ``max_px`` between two at
    ``speed`` px/s, and that every row's exposure has ``lens`` of them; at most ``most``, at least 1.   changes : of
    light, per second: each instant has the mean light of its cell, so only rows that are exposed at other times need
    cells of a fraction of them."""
    span_ns = exposure.end_ns - exposure.start_ns
    moving = speed * span_ns * 1e-9 / max_px
    focusing = lens * span_ns / exposure.exposure_ns if lens > 1 else 1.0
    flickering = min(_PER_CHANGE * changes * span_ns * 1e-9, 1e9) if exposure.row_ns else 0.0
    # 1e-6, so that a rounding error adds no instant.
    return int(
        min(most, max(1.0, math.ceil(min(moving, 1e9) - 1e-6), *(math.ceil(n - 1e-6) for n in (focusing, flickering))))
    )


_PER_CHANGE = 8
"""Instants of a rolling shutter for each jump or turn of the light."""


@kernel
def accumulate(total: np.ndarray, image: np.ndarray, weights: np.ndarray) -> None:
    """Add weights[row] * image to total, (H, W, 3) float64 each, image float32 (H, W, 3 or more)."""
    height, width, channels = total.shape
    for y in range(height):
        weight = weights[y]
        if weight > 0.0:
            for x in range(width):
                for c in range(channels):
                    total[y, x, c] += weight * image[y, x, c]


# ---------------------------------------------------------------------------------------------------------------------
# Automatic exposure: a first-order lag in the logarithm of exposure times gain.
#
# With m the mean of an image taken with the product P, 1 being the largest code, P* = P target / m would have met the
# target, and after dt seconds
#
# ln P' = ln P + (1 - exp(-dt / lag)) (ln P* - ln P)
#
# so that under constant light without clipping ln P approaches its end as exp(-t / lag), independent of the image rate.

_DARKEST = 1e-6
"""Mean below which an image only shows that it is too dark."""


@dataclass(frozen=True)
class Setting:
    """exposure_ns : of each row.   gain : a factor, not dB."""

    exposure_ns: int
    gain: float

    @property
    def product(self) -> float:
        """Return exposure times gain, ns."""
        return self.exposure_ns * self.gain


def decibels(gain: float) -> float:
    """Return the dB of a voltage factor."""
    return 20.0 * math.log10(gain)


def factor(gain_db: float) -> float:
    """Return the voltage factor of a gain in dB."""
    return 10.0 ** (gain_db / 20.0)


def next_setting(config: AutoExposureConfig, setting: Setting, mean: float, dt_s: float) -> Setting:
    """Return the setting of the image ``dt_s`` after one with ``setting`` whose mean is ``mean`` (linear, 1 is the
    largest code)."""
    share = 1.0 - math.exp(-dt_s / config.lag) if config.lag > 0 else 1.0
    wanted = setting.product * (config.target / max(mean, _DARKEST)) ** share
    shortest, longest = NS_PER_US * config.shortest_us, NS_PER_US * config.longest_us
    exposure_ns = round(min(max(wanted, shortest), longest))
    # The gain supplies what the longest exposure does not.
    return Setting(exposure_ns, min(max(wanted / exposure_ns, 1.0), factor(config.max_gain_db)))
