"""Light that changes over time: ``over_time`` of lights, ``emission_over_time`` of materials (docs/light.md)."""

from __future__ import annotations

import itertools
from typing import Annotated, Literal

from pydantic import Field

from blinkgl.config.base import Config, Refused, one_of, rule

Share = Annotated[float, Field(ge=0, le=1)]
Hertz = Annotated[float, Field(gt=0, le=1e9)]
MAX_CHANGES = 1_000_000
"""Largest number of jumps and turns of one light in a sequence: each takes two frames."""


class SineConfig(Config):
    """1 + depth sin(2 pi (frequency t + phase)): mains flicker."""

    kind: Literal["sine"]
    frequency: Hertz = Field(description="Hz; of lamps on alternating current twice the mains frequency")
    depth: Share = Field(1.0, description="0: constant; 1: dark once a period")
    phase: float = Field(0.0, ge=-1e6, le=1e6, description="fraction of a period that has passed at 0 s")


class PwmConfig(Config):
    """On for a share of each period, from its start on: dimmed LEDs, blinking markers."""

    kind: Literal["pwm"]
    frequency: Hertz = Field(description="Hz")
    duty: Share = Field(0.5, description="share of a period that it is on; 0: never, 1: always")
    phase: float = Field(0.0, ge=-1e6, le=1e6, description="fraction of a period that has passed at 0 s")
    low: Share = Field(0.0, description="factor while it is off")


class CodeConfig(Config):
    """Bits one after the other from 0 s on: visible light communication."""

    kind: Literal["code"]
    bits: Annotated[str, Field(pattern="^[01]+$", max_length=100_000)] = Field(
        description='text such as "10110": 1 is on'
    )
    rate: Hertz = Field(description="bits per second")
    low: Share = Field(0.0, description="factor of a 0")
    repeat: bool = Field(True, description="repeat after the end; false: off")


class LightKeyConfig(Config):
    """A factor at a time."""

    time: float = Field(ge=-1e7, le=1e7, description="s on the sequence's clock")
    factor: float = Field(ge=0, le=1e6, description="times the strength, or the emission")


class LightKeysConfig(Config):
    """Factors at times; the first before all, the last after them."""

    kind: Literal["keys"]
    keys: Annotated[tuple[LightKeyConfig, ...], Field(min_length=1, max_length=100_000)] = Field(
        description="with increasing times"
    )
    interpolation: Literal["linear", "hold"] = Field("linear", description="hold: each until the next")

    @rule("keys.*.time")
    def _in_order(times: tuple[float, ...]):
        for k, (before, after) in enumerate(itertools.pairwise(times)):
            if round(1e9 * after) <= round(1e9 * before):
                raise Refused("the keys' times must increase", where=f"keys.{k + 1}.time", value=after)


WaveformConfig = one_of("kind", SineConfig, PwmConfig, CodeConfig, LightKeysConfig)
OVER_TIME = Field(None, description="factor over time: sine, pwm, code or keys (docs/light.md); null: constant")
