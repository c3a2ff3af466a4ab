"""``frames:`` section: sequences converted from recorded or rendered frames, such as
TartanAir's, instead of from a scene."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from blinkgl.config.base import Config, Refused, rule
from blinkgl.config.values import Paths

MAX_SPAN_S = (2**32 - 1) * 1e-6
"""Longest recording of one event file, s: DSEC counts its microseconds in 32 bits."""


def _limit(default: float | None, most: float, what: str) -> float | None:
    return Field(default, ge=0, le=most, description=f"{what}; null: no limit")


class QualifyConfig(Config):
    """Which frames are near enough to each other to be interpolated. A pair of frames with a measure beyond its limit
    does not qualify, and with too many such pairs the sequence does not. `blinkgl explain` prints the measures;
    the limits were chosen on rendered scenes whose in-between frames are known."""

    displacement: float | None = _limit(
        17.0, 1e4, "99th percentile of the given flow (without one, of the interpolation's own), px"
    )
    hidden: float | None = _limit(
        0.12,
        1,
        "share of pixels that the next frame does not show, because forward and backward flow contradict each other "
        "(with `backward`), or because the masks say so",
    )
    uncovered: float | None = _limit(
        0.08, 1, "share of the next frame's pixels that no vector of the given flow leads to"
    )
    residual: float | None = _limit(
        0.2,
        100,
        "mean of |ln b(x + flow) - ln a(x)| over what both frames show: change that the given flow does not explain; "
        "more than this is a flow of other frames",
    )
    thin: float | None = _limit(
        0.01,
        1,
        "share of pixels on structures that move, against what surrounds them, by more than their own width, by the "
        "given flow",
    )
    contradicted: float | None = _limit(
        0.17,
        1,
        "share of pixels whose forward and backward flow, as the interpolation finds them, contradict each other",
    )
    astray: float | None = _limit(
        0.3,
        1,
        "share of the light's gradient where the interpolation's own flow is off the given one by more than 1 px and "
        "5 %",
    )
    fine: float | None = _limit(
        0.33, 1, "share of the light's variation along rows and columns that a shift by half a pixel loses"
    )
    left_out: float | None = _limit(
        0.5,
        100,
        "error of a frame as interpolated from the two beside it, mean of |ln guess - ln frame|, over the mean change "
        "between those two",
    )
    tolerated: float = Field(0.0, ge=0, le=1, description="share of the pairs that may be beyond a limit")


class FramesConfig(Config):
    """Frames of a folder through the event emulator; a flow file per pair of frames becomes the label."""

    folders: Paths = Field(
        (),
        description="folders of one sequence each, or patterns such as `/data/tartanair/*/*/P0*`; sequence n takes "
        "the n-th in alphabetical order",
    )
    images: str = Field("image_left", description="sub-folder of the images, or '.'")
    flow: str | None = Field(
        "flow",
        description="sub-folder of the optical flow, one file per pair of frames in their order: .npy "
        "(H, W, 2 or 3), .flo or DSEC .png; null: none",
    )
    backward: str | None = Field(
        None,
        description="sub-folder of the optical flow back, one file per pair of frames in their order, from the second "
        "to the first; only `qualify` looks at it; null: none",
    )
    fps: float = Field(
        10.0,
        ge=0.001,
        le=1e6,
        description="frames per second that the frames are taken to have, Hz; flow labels come at this rate",
    )
    first: int = Field(0, ge=0, description="frames left out at the beginning")
    count: int | None = Field(None, ge=3, description="frames used; null: all")
    gamma: Literal["srgb", "linear"] = Field("srgb", description="transfer curve of the images")
    interpolate: Literal["linear", "cubic", "motion"] = Field(
        "motion", description="between frames: as `blinkgl simulate --interpolate`"
    )
    max_px: float = Field(1.0, gt=0, le=1e3, description="motion: largest displacement per step, px")
    factor: int = Field(4, ge=1, le=1000, description="cubic: steps per given frame")
    qualify: QualifyConfig | None = Field(
        QualifyConfig(), description="limits that the frames are checked by before they are converted; null: no check"
    )

    @rule("fps", "count")
    def _fits_a_file(fps: float, count: int | None):
        check_span(count or 3, fps)


def check_span(frames: int, fps: float) -> None:
    """Refuses ``frames`` frames at ``fps`` that are longer than one event file can hold."""
    if (frames - 1) / fps > MAX_SPAN_S:
        raise Refused(
            f"{frames} frames at this rate last {(frames - 1) / fps:.6g} s, more than the {MAX_SPAN_S:.1f} s that an "
            "event file can hold",
            where="fps",
            value=fps,
            accepted=f"at least {(frames - 1) / MAX_SPAN_S:.4g}, or fewer frames",
        )
