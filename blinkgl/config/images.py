"""The ``images:`` section: the frame camera beside the event camera (:mod:`blinkgl.imaging`)."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import ClassVar, Literal

from pydantic import Field, model_validator

from blinkgl.config.base import Config, Former, Refused, always, rule
from blinkgl.types.trees import Tree

NS_PER_S, NS_PER_US = 1_000_000_000, 1000
MAX_IMAGES = 1_000_000
"""File names have six digits."""


Bayer = Literal["rggb", "bggr", "grbg", "gbrg"]
"""Colours of the filters of a 2 x 2 block, row by row."""


class LensConfig(Config):
    """A thin lens: a point out of focus is imaged as a disc."""

    aperture: float = Field(gt=0, le=1e6, description="diameter of the lens, world units; focal length / f-number")
    focus: float = Field(gt=0, le=1e9, description="depth in focus, along the optical axis, world units")


class AutoExposureConfig(Config):
    """Exposure time and then gain follow the light, one image late and with a lag."""

    target: float = Field(
        0.18, gt=0, lt=1, description="mean of the image that it aims at, linear; 1 is the largest code"
    )
    lag: float = Field(0.2, ge=0, le=1e4, description="time constant, s; 0: immediate")
    shortest_us: ClassVar[float] = 20.0
    """Shortest exposure, µs."""
    former: ClassVar[dict[str, Former]] = {"shortest_us": always(shortest_us)}
    longest_us: float = Field(20000.0, ge=shortest_us, le=1e9, description="longest exposure, µs; the shortest is 20")
    max_gain_db: float = Field(24.0, ge=0, le=60, description="highest gain, dB")


class ImagesConfig(Config):
    """A frame camera in the event camera's pixels (docs/cameras.md). It sets `labels.images` to false unless that is
    given."""

    presets: ClassVar[dict[str, Tree]] = {
        "plain": {},
        "deblurring": {
            "rate": 24.0,
            "exposure_us": 33000.0,
            "photon_noise": True,
            "read_noise": 2.0,
            "also": ["sharp"],
        },
        "interpolation": {"rate": 240.0, "exposure_us": 500.0, "photon_noise": True, "read_noise": 2.0},
        "low_light": {
            "rate": 20.0,
            "exposure_us": 15000.0,
            "gain_db": 30.0,
            "photon_noise": True,
            "read_noise": 4.0,
            "also": ["clean"],
        },
        "rolling_shutter": {"rate": 30.0, "exposure_us": 2000.0, "row_us": 60.0, "also": ["sharp"]},
        "raw": {
            "photon_noise": True,
            "read_noise": 2.5,
            "bits": 12,
            "response": "linear",
            "black": 0.0625,
            "bayer": "rggb",
            "also": ["clean"],
        },
    }

    preset: Literal["plain", "deblurring", "interpolation", "low_light", "rolling_shutter", "raw"] = Field(
        "plain",
        description="values of the other keys; keys beside it override it",
    )
    rate: float | None = Field(
        30.0,
        gt=0,
        le=1e5,
        description="images per second, Hz, the first exposed at the sequence's start; null with `times`",
    )
    times: tuple[float, ...] | None = Field(
        None,
        min_length=1,
        max_length=MAX_IMAGES,
        description="starts of exposures, s on the sequence's clock, instead of a rate",
    )
    exposure_us: float = Field(5000.0, ge=1, le=1e9, description="exposure time of each pixel, µs")
    row_us: float = Field(
        0.0, ge=0, le=1e6, description="rolling shutter: delay of each row's exposure after the row above, µs"
    )
    max_px: float = Field(
        0.5,
        gt=0,
        le=1e3,
        description="largest motion between two instants of an exposure, px",
    )
    max_instants: int = Field(256, ge=1, le=65536, description="largest number of instants per image")
    white: float = Field(
        1.0, gt=0, le=1e9, description="linear radiance of the largest code, at the exposure and gain given here"
    )
    gain_db: float = Field(
        0.0,
        ge=0,
        le=60,
        description="gain, dB: white is then full_well / gain electrons, so noise grows",
    )
    full_well: float = Field(10000.0, ge=1, le=1e9, description="electrons at which a pixel saturates")
    photon_noise: bool = Field(False, description="Poisson distributed electrons")
    read_noise: float = Field(0.0, ge=0, le=1e6, description="standard deviation of the read-out, electrons")
    black: float = Field(0.0, ge=0, le=0.5, description="value without light, a fraction of the linear scale")
    bits: int = Field(
        8, ge=8, le=16, description="bits per code; more than 8 are written as 16-bit PNG with unscaled codes"
    )
    response: Literal["srgb", "gamma", "linear"] = Field("srgb", description="curve from linear light to codes")
    gamma: float = Field(2.2, ge=0.1, le=10, description="for `response: gamma`: code = light ^ (1 / gamma)")
    bayer: Bayer | None = Field(
        None,
        description="one colour per pixel in this pattern, from the top left: one channel",
    )
    vignetting: float = Field(
        0.0,
        ge=0,
        le=1,
        description="fraction of the natural fall-off, cos^4 of the angle to the optical axis; 1: all of it",
    )
    lens: LensConfig | None = Field(None, description="null: a pinhole, everything is in focus")
    auto_exposure: AutoExposureConfig | None = Field(None, description="null: constant exposure and gain")
    also: tuple[Literal["sharp", "clean"], ...] = Field(
        (),
        description="further pictures. sharp: an instant in the middle of the exposure, no noise; clean: the image "
        "without noise",
    )

    @model_validator(mode="before")
    @classmethod
    def _times_instead_of_a_rate(cls, data: object) -> object:
        """Return the keys with a rate of null beside times: the rate of a preset or the default would contradict."""
        return {"rate": None, **data} if isinstance(data, dict) and data.get("times") is not None else data

    @rule("auto_exposure.longest_us", "auto_exposure.max_gain_db", "exposure_us", "gain_db")
    def _begins_inside(longest, most_db, exposure, gain):
        if longest is None:
            return
        shortest = AutoExposureConfig.shortest_us
        if not shortest <= exposure <= longest:
            raise Refused(
                "the first exposure is outside the limits of auto_exposure",
                where="exposure_us",
                value=exposure,
                accepted=f"from {shortest:g} to {longest:g} (auto_exposure)",
            )
        if gain > most_db:
            raise Refused(
                "the first gain is above the limit of auto_exposure",
                where="gain_db",
                value=gain,
                accepted=f"at most {most_db:g} (auto_exposure.max_gain_db)",
            )

    @rule("rate", "times")
    def _either(rate: float | None, times: tuple[float, ...] | None):
        if (rate is None) == (times is None):
            raise Refused(
                "neither a rate nor times are given" if times is None else "images are taken at a rate or at times",
                where="rate",
                value=rate,
                accepted="a rate" if times is None else "null beside images.times",
            )

    @rule("rate", "times", "exposure_us", "auto_exposure.longest_us")
    def _one_at_a_time(rate: float | None, times: tuple[float, ...] | None, exposure: float, longest: float | None):
        key = "exposure_us" if longest is None else "auto_exposure.longest_us"
        exposure = exposure if longest is None else longest
        if rate is not None and exposure * rate > 1e6 * (1 + 1e-9):
            raise Refused(
                "the exposure is longer than the image interval",
                where=key,
                value=exposure,
                accepted=f"at most {1e6 / rate:g}, or a lower rate",
            )
        for before, after in pairwise(times or ()):
            if after - before < 1e-6 * exposure * (1 - 1e-9):
                raise Refused(
                    "exposure times are out of order, or closer than the exposure time",
                    where="times",
                    value=[before, after],
                    accepted=f"increasing, {1e-6 * exposure:g} s apart at least",
                )

    @rule("response", "gamma")
    def _gamma_is_used(response, gamma):
        if response != "gamma" and gamma != 2.2:
            raise Refused("gamma needs `response: gamma`", where="gamma", value=gamma, accepted="response: gamma")

    @rule("also")
    def _each_once(also: tuple[str, ...]):
        if len(set(also)) < len(also):
            raise Refused("given twice", where="also", value=list(also), accepted="sharp and clean, each once")

    @property
    def pictures(self) -> tuple[str, ...]:
        """Return what is written of each image: "images", and those of ``also``."""
        return ("images", *(name for name in ("sharp", "clean") if name in self.also))

    @property
    def longest_us(self) -> float:
        """Return the longest exposure of a pixel, µs."""
        return self.exposure_us if self.auto_exposure is None else self.auto_exposure.longest_us

    @property
    def noisy(self) -> bool:
        """Return whether two seeds give different images."""
        return self.photon_noise or self.read_noise > 0


def readout_us(rows: int, row_us: float) -> float:
    """Return the time from the first row's exposure to the last row's, µs."""
    return (rows - 1) * row_us


def exposure_starts(images: ImagesConfig, t0_ns: int, t1_ns: int, rows: int) -> list[int]:
    """Return the starts of the first row's exposures, ns: all whose last row ends within [t0, t1] at the longest
    exposure."""
    lasts_ns = round(NS_PER_US * (images.longest_us + readout_us(rows, images.row_us)))
    if images.rate is None:
        starts = [round(NS_PER_S * t) for t in images.times or ()]
        # A nanosecond: each of these is rounded.
        return [start for start in starts if t0_ns - 1 <= start <= t1_ns - lasts_ns + 1]
    # 1e-9, so that rounding does not lose an exposure that just fits.
    count = math.floor(((t1_ns - t0_ns - lasts_ns) * images.rate) / NS_PER_S + 1e-9) + 1
    return [t0_ns + round(k * NS_PER_S / images.rate) for k in range(max(count, 0))]


def check_images(
    rate: float | None,
    times: tuple[float, ...] | None,
    lasts_us: float,
    rows_us: float,
    start: float,
    seconds: float,
) -> None:
    """Check a sequence that begins at ``start``, s, and lasts ``seconds``. Raises Refused."""
    whole_us = lasts_us + rows_us
    if rate is not None:
        if rows_us * rate > 1e6 * (1 + 1e-9):
            raise Refused(
                "the read-out of the rows is longer than the image interval",
                where="images.row_us",
                value=rows_us,
                accepted=f"at most {1e6 / rate:g} µs for all rows together, or a lower rate",
            )
        if whole_us > 1e6 * seconds * (1 + 1e-9):
            raise Refused(
                "no exposure fits into the sequence",
                where="images.exposure_us",
                value=lasts_us,
                accepted=f"at most {1e6 * seconds - rows_us:g}, or a longer time.duration",
            )
        if seconds * rate > MAX_IMAGES:
            raise Refused(
                f"{seconds * rate:.0f} images",
                where="images.rate",
                value=rate,
                accepted=f"at most {MAX_IMAGES} in a sequence",
            )
    for before, after in pairwise(times or ()):
        if 1e6 * (after - before) < rows_us * (1 - 1e-9):
            raise Refused(
                "the read-out of the rows is longer than the image interval",
                where="images.times",
                value=[before, after],
                accepted=f"{1e-6 * rows_us:g} s apart at least, or a smaller images.row_us",
            )
    for t in times or ():
        if not start - 1e-9 <= t <= start + seconds - 1e-6 * whole_us + 1e-9:
            raise Refused(
                "an exposure outside the sequence",
                where="images.times",
                value=t,
                accepted=f"from {start:g} to {start + seconds - 1e-6 * whole_us:g}",
            )
