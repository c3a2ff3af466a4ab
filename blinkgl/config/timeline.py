"""The ``timeline:`` section: times of the event frames."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from blinkgl.config.base import Config, Former, Refused, always, one_of, rule

_NO_RECONSTRUCTION = {
    "reconstruction": Former(
        "the key left out (event times are interpolated linearly between frames; a smaller max_px "
        "makes them more accurate)",
        lambda value: value == "linear",
    )
}


class _Timeline(Config):
    former: ClassVar[dict[str, Former]] = _NO_RECONSTRUCTION


class UniformTimeline(_Timeline):
    """Event frames at a fixed rate."""

    kind: Literal["uniform"] = "uniform"
    fps: float = Field(
        300.0, ge=0.001, le=1e9, description="frames per second, Hz; emulators take frames at most 17 minutes apart"
    )


class _AdaptiveTimeline(_Timeline):
    min_step_us: float = Field(200.0, ge=0.001, description="shortest step, µs")
    max_step_us: float = Field(
        20000.0,
        ge=0.001,
        le=1e9,
        description="longest step, µs; emulators take frames at most 17 minutes apart",
    )

    @rule("min_step_us", "max_step_us")
    def _ordered(least, most):
        # Equal ones are a fixed step.
        if least > most:
            raise Refused(f"min_step_us must not exceed max_step_us = {most}", value=least)


class DisplacementTimeline(_AdaptiveTimeline):
    """Event frames between which no surface, hidden ones included, moves further than ``max_px`` in the picture."""

    former: ClassVar[dict[str, Former]] = {
        **_NO_RECONSTRUCTION,
        "sample_every": Former("the key left out: no picture is drawn for the step", lambda value: True),
        "first_look": Former("the key left out, or quality: fast for fewer frames", lambda value: value is False),
    }

    kind: Literal["displacement"] = "displacement"
    max_px: float = Field(
        0.5, gt=0, le=1e4, description="largest displacement between two frames, px, for the percentile"
    )
    percentile: float = Field(
        100.0,
        gt=0,
        le=100,
        description="percentile of the speeds of moving surfaces, by area in the picture",
    )
    max_px_peak: float | None = Field(
        None,
        gt=0,
        le=1e4,
        description="limit for the fastest surface, px; for a percentile below 100",
    )


class BrightnessTimeline(_AdaptiveTimeline):
    """Event frames between which the signal changes by at most a fraction of the contrast threshold, and edges of at
    least a threshold move by at most as many pixels."""

    kind: Literal["brightness"] = "brightness"
    sample_every: ClassVar[int] = 4
    """The step is chosen from a small picture with every n-th pixel in x and y."""
    former: ClassVar[dict[str, Former]] = {**_NO_RECONSTRUCTION, "sample_every": always(sample_every)}
    max_fraction_of_threshold: float = Field(
        1.0,
        gt=0,
        le=100,
        description="largest change between two frames, in units of the smallest nominal contrast threshold, and of "
        "edges in px",
    )
    percentile: float = Field(
        95.0,
        gt=0,
        le=100,
        description="percentile of |dL/dt| over the changing pixels; 100 bounds every sampled pixel; edges count by "
        "the fastest",
    )


TimelineConfig = one_of("kind", UniformTimeline, DisplacementTimeline, BrightnessTimeline, default="displacement")
