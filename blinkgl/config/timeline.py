"""When event frames are drawn, and what the signal does between them."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from blinkgl.config.base import Config, Refused, one_of, rule
from blinkgl.config.events import followers


class _Timeline(Config):
    reconstruction: Literal["linear", "pchip", "hermite"] = Field(
        "linear",
        description="log intensity between two frames. linear: straight lines. pchip: monotone cubics over the "
        "neighbouring frames, free of rendering. hermite: monotone cubics with dL/dt from the "
        "shader, which makes frames dearer and fewer enough. The cubics are for `events.emulator: "
        f"{' or '.join(followers('pchip'))}`",
    )


class UniformTimeline(_Timeline):
    """Event frames at a fixed rate."""

    kind: Literal["uniform"] = "uniform"
    fps: float = Field(
        300.0, ge=0.001, le=1e9, description="frames per second, Hz; emulators take frames at most 17 minutes apart"
    )


class _AdaptiveTimeline(_Timeline):
    sample_every: int = Field(
        4,
        ge=1,
        le=64,
        description="the small picture that decides the step looks at every n-th pixel in x and y; 1 at all of them",
    )
    min_step_us: float = Field(200.0, ge=0.001, description="the step is never shorter, µs")
    max_step_us: float = Field(
        20000.0,
        ge=0.001,
        le=1e9,
        description="the step is never longer, µs; emulators take frames at most 17 minutes apart",
    )

    @rule("min_step_us", "max_step_us")
    def _ordered(least, most):
        if least > most:
            raise Refused(f"min_step_us must not exceed max_step_us = {most}", value=least)


class DisplacementTimeline(_AdaptiveTimeline):
    """Event frames so far apart that pixels move no more than ``max_px`` from one to the next, by
    the speeds at both ends of the step."""

    kind: Literal["displacement"] = "displacement"
    max_px: float = Field(
        0.5, gt=0, le=1e4, description="displacement between two frames, px, that the percentile keeps to"
    )
    percentile: float = Field(
        100.0, gt=0, le=100, description="of the speeds of the pixels that move; 100 bounds every sampled pixel"
    )
    max_px_peak: float | None = Field(
        None,
        gt=0,
        le=1e4,
        description="what the fastest sampled pixel keeps to besides, px; for a percentile below 100",
    )
    first_look: bool = Field(
        False,
        description="each sequence is looked at before it begins: where frames twice as far apart would make its "
        "events less than 1.3 times as wrong, they are (docs/trade.md, `auto`). Takes half a second; the manifest "
        "has what was seen",
    )


class BrightnessTimeline(_AdaptiveTimeline):
    """Event frames so far apart that the signal changes by no more than a fraction of the contrast threshold, by
    |dL/dt| from the shader at both ends of the step."""

    kind: Literal["brightness"] = "brightness"
    max_fraction_of_threshold: float = Field(
        1.0, gt=0, le=100, description="change between two frames, in smallest nominal contrast thresholds"
    )
    percentile: float = Field(
        95.0, gt=0, le=100, description="of |dL/dt| over the pixels that change; 100 bounds every sampled pixel"
    )


class BudgetTimeline(_AdaptiveTimeline):
    """Event frames so far apart that event times are as wrong as is allowed: the error of the reconstruction in use is
    measured while frames are drawn, and the achieved estimate goes into the manifest."""

    kind: Literal["budget"] = "budget"
    max_time_error_us: float | None = Field(
        None, gt=0, le=1e9, description="error of event times, µs; give this or max_time_error_px"
    )
    max_time_error_px: float | None = Field(
        None, gt=0, le=1e4, description="the same times the image speed: how far an edge is from where it should be, px"
    )
    percentile: float = Field(75.0, gt=0, le=99.9, description="of the events' errors, which keeps to the budget")

    @rule("max_time_error_us", "max_time_error_px")
    def _one_of(us, px):
        if (us is None) == (px is None):
            raise Refused("give max_time_error_us or max_time_error_px, one of the two")


TimelineConfig = one_of(
    "kind", UniformTimeline, DisplacementTimeline, BrightnessTimeline, BudgetTimeline, default="displacement"
)
