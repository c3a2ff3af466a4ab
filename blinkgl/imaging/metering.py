"""Automatic exposure: a first-order lag in the logarithm of exposure times gain.

With m the mean of an image taken with the product P, 1 being the largest code, P* = P target / m is what would have met
the target, and after dt seconds

    ln P' = ln P + (1 - exp(-dt / lag)) (ln P* - ln P)

so that under constant light that clips nowhere ln P approaches its end as exp(-t / lag) whatever the image rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from blinkgl.config.images import NS_PER_US, AutoExposureConfig

_DARKEST = 1e-6
"""Mean below which an image says no more than that it is too dark."""


@dataclass(frozen=True)
class Setting:
    """exposure_ns : of each row.   gain : a factor, not dB."""

    exposure_ns: int
    gain: float

    @property
    def product(self) -> float:
        """ns, at gain 1."""
        return self.exposure_ns * self.gain


def decibels(gain: float) -> float:
    """Of a factor of voltage."""
    return 20.0 * math.log10(gain)


def factor(gain_db: float) -> float:
    """Of so many dB, of voltage."""
    return 10.0 ** (gain_db / 20.0)


def next_setting(config: AutoExposureConfig, setting: Setting, mean: float, dt_s: float) -> Setting:
    """What the image ``dt_s`` after one with ``setting``, whose mean is ``mean`` (linear, 1 is the largest code), is
    taken with."""
    share = 1.0 - math.exp(-dt_s / config.lag) if config.lag > 0 else 1.0
    wanted = setting.product * (config.target / max(mean, _DARKEST)) ** share
    shortest, longest = NS_PER_US * config.shortest_us, NS_PER_US * config.longest_us
    exposure_ns = round(min(max(wanted, shortest), longest))
    return Setting(exposure_ns, min(max(wanted / exposure_ns, 1.0), factor(config.max_gain_db)))
