"""What stands between the pixels of a sensor and the outside: pixels that are broken or noisy by themselves, the bus
and its clock. In this order; what is not said is not there."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import Field

from blinkgl.config.base import Config, Refused, Removed, rule


class PixelsConfig(Config):
    """Pixels that are dead, hot, or fire in the dark, whatever the emulator: drawn once, from the sequence's seed.

    Noise events are a Poisson process of each pixel's own rate, beside the emulator's events and without a word to its
    comparators. Rates are log-normal over the pixels, hot ones about a median of their own. Some are answered: noise
    that passed one threshold comes back through the other, so that an event of the opposite polarity follows, later by
    a log-normal time. Both are in the rates. Hot pixels answer nothing; each prefers ON or OFF by itself: its share is
    logit-normal. (What dvxplorer_constant_light shows: a hot pixel's events are 40 % more of one polarity than of the
    other, those of other pixels balance each other.)"""

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
        0.5, ge=0, le=1, description="Share of ON events of the other pixels, among those that answer no other."
    )
    answered: float = Field(
        0.0,
        ge=0,
        le=1,
        description="Share of the other pixels' noise events that one of the opposite polarity follows.",
    )
    answer_ms: float = Field(30.0, ge=0.001, le=1e3, description="Median time from an event to its answer, ms.")
    answer_spread_decades: float = Field(0.5, ge=0, le=1, description="Spread of that time, decades.")
    refractory_us: float = Field(
        0.0,
        ge=0,
        le=1e6,
        description="Dead time of a pixel's noise after an event of it, microseconds; rates are without.",
    )


class FrameResetsConfig(Config):
    """A camera of events and frames: where the frame's pixels are reset, the signal of all event pixels jumps and comes
    back, and those that stand near their threshold fire; see :mod:`blinkgl.events.resets`."""

    interval_ms: float = Field(gt=2, le=10_000, description="Time from one reset to the next, ms: that of the frames.")
    kick: float = Field(
        gt=0, le=5, description="Height of the jump, in thresholds (the smaller of the emulator's ON and OFF ones)."
    )
    length_ms: float = Field(1.0, gt=0, le=1000, description="Time that the signal takes to come back, ms.")
    first_ms: float = Field(0.0, ge=0, le=10_000, description="First reset after the first frame, ms.")

    @rule("interval_ms", "length_ms")
    def _over_before_the_next(interval: float, length: float):
        if length + 1 > interval:
            raise Refused("the jump lasts into the next one", where="length_ms", value=length,
                          accepted=f"at most {interval - 1:g}, a millisecond less than interval_ms")  # fmt: skip


class ReadoutConfig(Config):
    """The bus between pixels and time stamps; see :mod:`blinkgl.events.camera`. Before it the pixels' own noise:
    :mod:`blinkgl.events.pixels`."""

    removed: ClassVar[Any] = {
        "filters": Removed("events filtered after they were written", lambda value: not value),
        "latency": Removed("the key left out: v2e's cutoff_hz makes events late", lambda value: value is None),
    }

    events_per_second: float | None = Field(
        None,
        ge=1,
        le=1e12,
        description="Peak rate of the bus, events per second; null: no bus, no event is late or lost.",
    )
    row_ns: float = Field(
        0.0,
        ge=0,
        le=1e6,
        description="Time to open a row before its events go out, nanoseconds; 0: every event is arbitrated by itself.",
    )
    queue_events: int = Field(
        4096, ge=1, le=2**24, description="Events that may wait for the bus; one that finds the queue full is lost."
    )
    clock_us: int = Field(
        1,
        ge=1,
        le=1_000_000,
        description="Time stamps are multiples of this, microseconds: the last one that has passed.",
    )
    pixels: PixelsConfig | None = Field(None, description="Dead, hot and noisy pixels; null: none.")
    frame_resets: FrameResetsConfig | None = Field(
        None, description="Bursts of events that the camera's frames set off; null: none."
    )

    @rule("events_per_second", "row_ns", "queue_events")
    def _queue_empties(rate: float | None, row_ns: float, queue: int):
        if drain_us(rate, row_ns, queue) > 2**32:
            raise Refused(
                "the last event of a full queue would wait for more than an hour",
                where="queue_events",
                value=queue,
                accepted="a shorter queue or a faster bus",
            )

    @property
    def drain_us(self) -> float:
        """Longest that an event may wait for the bus, microseconds: the time that a full queue takes to empty."""
        return drain_us(self.events_per_second, self.row_ns, self.queue_events)


def drain_us(events_per_second: float | None, row_ns: float, queue_events: int) -> float:
    """Longest wait for a bus, microseconds (see :class:`ReadoutConfig`)."""
    return 0.0 if events_per_second is None else (queue_events + 1) * (1e6 / events_per_second + row_ns / 1000)
