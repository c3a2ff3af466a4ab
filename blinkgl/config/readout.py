"""The ``readout:`` section, what happens to events between pixels and output: defective or noisy pixels, the bus, its
clock, in this order. Parts that are not given are absent."""

from __future__ import annotations

import itertools
from typing import Annotated, ClassVar

from pydantic import Field

from blinkgl.config.base import Config, Former, Refused, always, rule

_Px = Annotated[int, Field(ge=0, le=16384)]
_Rate = Annotated[float, Field(ge=0, le=1e4)]


class PixelsConfig(Config):
    """Dead, hot and noisy pixels, with any emulator.

    Each pixel's noise events are a Poisson process and do not change the emulator's state. Rates are log-normal over
    the pixels. A noise event may be followed by one of opposite polarity after a log-normal time (not in hot pixels);
    the rates include both. A hot pixel's share of ON events is logit-normal."""

    dead_fraction: float = Field(0.0, ge=0, le=1, description="Share of pixels that never fire.")
    hot_fraction: float = Field(0.0, ge=0, le=1, description="Share of pixels that are hot.")
    hot_rate_hz: float = Field(0.0, ge=0, le=1e5, description="Median rate of a hot pixel, events per second.")
    hot_spread_decades: float = Field(0.0, ge=0, le=3, description="Spread of the hot pixels' rates, decades.")
    rate_hz: float = Field(0.0, ge=0, le=1e4, description="Median rate of the other pixels, events per second.")
    spread_decades: float = Field(0.0, ge=0, le=3, description="Spread of the other pixels' rates, decades.")
    hot_on_share: float = Field(0.5, ge=0, le=1, description="Median share of ON events of a hot pixel.")
    hot_on_spread: float = Field(
        0.0,
        ge=0,
        le=10,
        description="Spread of the hot pixels' shares: standard deviation of log(ON share / OFF share).",
    )
    on_share: float = Field(
        0.5,
        ge=0,
        le=1,
        description="Share of ON events among the other pixels' noise events, without those that follow another.",
    )
    answered: float = Field(
        0.0,
        ge=0,
        le=1,
        description="Fraction of the other pixels' noise events that are followed by one of opposite polarity.",
    )
    answer_ms: float = Field(30.0, ge=0.001, le=1e3, description="Median time from an event to this answer, ms.")
    answer_spread_decades: float = Field(0.5, ge=0, le=1, description="Spread of that time, decades.")
    refractory_us: float = Field(
        0.0,
        ge=0,
        le=1e6,
        description="Dead time after a noise event, microseconds; rates are without it.",
    )


class LightNoiseConfig(Config):
    """Noise events by the light, with ``v2e`` and ``voltmeter`` (docs/sensors.md). A Poisson process per pixel; between
    the given lights, log(rate) is linear in log(light)."""

    lux: tuple[Annotated[float, Field(gt=0, le=1e7)], ...] = Field(
        min_length=1, max_length=256, description="Light on the scene, lux, increasing."
    )
    on_hz: tuple[_Rate, ...] = Field(description="ON noise events per second and pixel at each light.")
    off_hz: tuple[_Rate, ...] = Field(description="OFF noise events per second and pixel at each light.")
    white_lux: float = Field(1000.0, gt=0, le=1e9, description="Light on the scene where luminance is 1, lux.")
    shape: float | None = Field(
        None,
        ge=0.01,
        le=1e6,
        description="Shape of the gamma law of the pixels' rates; null: all pixels are alike.",
    )

    @rule("lux", "on_hz", "off_hz")
    def _a_curve(lux: tuple[float, ...], on: tuple[float, ...], off: tuple[float, ...]):
        if any(b <= a for a, b in itertools.pairwise(lux)):
            raise Refused("must increase", where="lux", value=list(lux))
        for key, rates in (("on_hz", on), ("off_hz", off)):
            if len(rates) != len(lux):
                raise Refused("a rate for each light", where=key, value=len(rates), accepted=f"{len(lux)}, as of lux")


class FrameResetsConfig(Config):
    """Each reset of the frame's pixels makes the signal of all event pixels jump and return, so that pixels near their
    threshold fire."""

    interval_ms: float = Field(gt=2, le=10_000, description="Time between resets, ms: the frame interval.")
    kick: float = Field(gt=0, le=5, description="Height of the jump, in units of the smaller threshold.")
    length_ms: ClassVar[float] = 1.0
    """Time until the signal has returned, ms; shorter than any interval."""
    former: ClassVar[dict[str, Former]] = {"length_ms": always(length_ms)}
    first_ms: float = Field(0.0, ge=0, le=10_000, description="Time of the first reset after the first frame, ms.")


class ReadoutConfig(Config):
    """The bus between pixels and time stamps, and before it the pixels' noise."""

    former: ClassVar[dict[str, Former]] = {
        "filters": Former("events filtered after they were written", lambda value: not value),
        "latency": Former("the key left out: v2e's cutoff_hz makes events late", lambda value: value is None),
    }

    events_per_second: float | None = Field(
        None,
        ge=1,
        le=1e12,
        description="Peak rate of the bus, events per second; null: no bus.",
    )
    row_ns: float = Field(
        0.0,
        ge=0,
        le=1e6,
        description="Time to open a row before its events are sent, nanoseconds; 0: events are sent one by one.",
    )
    queue_events: int = Field(
        4096,
        ge=1,
        le=2**24,
        description="Events that may wait for the bus; further ones are lost.",
    )
    roi: tuple[_Px, _Px, _Px, _Px] | None = Field(
        None, description="[x, y, width, height], px: pixels outside of it are switched off."
    )
    max_rate: float | None = Field(
        None,
        ge=5000,
        le=1e12,
        description="Limit of the event rate controller, events per second (docs/sensors.md).",
    )
    clock_us: int = Field(
        1,
        ge=1,
        le=1_000_000,
        description="Resolution of time stamps, microseconds; they are rounded down.",
    )
    pixels: PixelsConfig | None = Field(None, description="Dead, hot and noisy pixels.")
    light_noise: LightNoiseConfig | None = Field(
        None, description="Noise events by the light, of emulators with noise of their own."
    )
    frame_resets: FrameResetsConfig | None = Field(None, description="Bursts of events caused by the camera's frames.")

    @rule("events_per_second", "row_ns", "queue_events")
    def _queue_empties(rate: float | None, row_ns: float, queue: int):
        if drain_us(rate, row_ns, queue) > 2**32:
            raise Refused(
                "the last event of a full queue would wait more than an hour",
                where="queue_events",
                value=queue,
                accepted="a shorter queue or a faster bus",
            )

    @rule("?roi", "roi")
    def _some_pixels(there, roi: tuple[int, int, int, int]):
        if there and not (roi[2] and roi[3]):
            raise Refused("a region without pixels", where="roi", value=list(roi))

    @property
    def drain_us(self) -> float:
        """Return the longest wait of an event for the bus, microseconds: the time that a full queue takes to empty."""
        return drain_us(self.events_per_second, self.row_ns, self.queue_events)


def drain_us(events_per_second: float | None, row_ns: float, queue_events: int) -> float:
    """Return the longest wait for a bus, microseconds (see :class:`ReadoutConfig`)."""
    return 0.0 if events_per_second is None else (queue_events + 1) * (1e6 / events_per_second + row_ns / 1000)
