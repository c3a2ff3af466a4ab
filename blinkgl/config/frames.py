"""The ``frames:`` section: sequences made from recorded or rendered frames, such as TartanAir's, instead of a scene."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from blinkgl.config.base import Config, Former, Refused, rule
from blinkgl.config.values import Paths

CURVES = ("srgb", "linear", "pq", "hlg")
ACCEPTED_CURVES = f"{', '.join(CURVES)} or an exponent up to 10"
FLOW_FORMATS = ("dsec", "kitti", "vkitti2", "tartanair2", "flo", "pfm", "flo5", "npy")
MAX_SPAN_S = (2**32 - 1) * 1e-6
"""Longest recording of one event file, s: DSEC stores microseconds in 32 bits."""


class FramesConfig(Config):
    """Folders of frames with flow (docs/video.md)."""

    folders: Paths = Field(
        (),
        description="folders of one sequence each, or patterns; sequence n uses the n-th in alphabetical order",
    )
    images: str = Field("image_left", description="sub-folder of the images, or '.'")
    flow: str | None = Field(
        "flow",
        description="sub-folder of the flow, a file per pair of frames: .npy (H, W, 2 or 3), .flo, .png, .pfm or "
        ".flo5; `{0}` is the folder's name, `{1}` its parent's …; null: none",
    )
    flow_format: str = Field(
        "auto",
        description="dsec, kitti, vkitti2, tartanair2, flo, pfm, flo5, npy; auto: by ending, and 16-bit PNGs by values",
    )
    flow_direction: Literal["auto", "forward", "backward"] = Field(
        "auto",
        description="forward: flow to the next frame; backward: to the one before; auto: backward where the names say "
        "so",
    )
    check_flow: bool = Field(
        True, description="refuse flow that explains the images worse than its double, half or negative, or none"
    )
    fps: float = Field(
        10.0,
        ge=0.001,
        le=1e6,
        description="frame rate that is assumed for the frames, Hz; flow labels have this rate",
    )
    first: int = Field(0, ge=0, description="frames skipped at the beginning")
    count: int | None = Field(None, ge=3, description="frames used; null: all")
    gamma: str | float | None = Field(
        None,
        description="transfer curve: srgb, linear, pq, hlg or an exponent; null: what the files state, else srgb for "
        "integers, linear for floats",
    )
    white_level: float | None = Field(
        None,
        gt=0,
        le=1e9,
        description="code of white, such as 4095 of 12 bits; null: what the files state, else the type's; required "
        "where 16-bit codes leave the upper two bits empty",
    )
    range: Literal["full", "limited"] | None = Field(
        None, description="of the codes: limited is 16 to 235 of 8 bits; null: full"
    )
    interpolate: Literal["linear", "motion"] = Field(
        "motion", description="between frames: as `blinkgl simulate --interpolate`"
    )
    max_px: float = Field(1.0, gt=0, le=1e3, description="for motion: largest displacement per step, px")
    keep_noise: bool = Field(
        False,
        description="make events of the images' noise, too (docs/video.md)",
    )
    max_displacement: float | None = Field(
        17.0,
        gt=0,
        le=1e4,
        description="99th percentile of the flow, px, above which a sequence is set aside; null: no check",
    )
    former: ClassVar[dict[str, Former]] = {
        "qualify": Former("max_displacement", lambda value: value is None or isinstance(value, dict)),
        "factor": Former(
            "the key left out: it belonged to interpolate: cubic, which was removed", lambda value: value == 4
        ),
        "backward": Former("the key left out: it has no effect", lambda value: value is None),
    }

    @rule("gamma")
    def _a_curve(gamma: str | float | None):
        if (isinstance(gamma, str) and gamma not in CURVES) or (isinstance(gamma, float) and not 0 < gamma <= 10):
            raise Refused("unknown transfer curve", where="gamma", value=gamma, accepted=ACCEPTED_CURVES)

    @rule("flow_format")
    def _a_format(flow_format: str):
        if flow_format not in ("auto", *FLOW_FORMATS):
            accepted = ", ".join(("auto", *FLOW_FORMATS))
            raise Refused("unknown format of flow", where="flow_format", value=flow_format, accepted=accepted)

    @rule("fps", "count")
    def _fits_a_file(fps: float, count: int | None):
        check_span(count or 3, fps)


def check_span(frames: int, fps: float) -> None:
    """Raise Refused for ``frames`` frames at ``fps`` that are longer than one event file can hold."""
    # n frames have n - 1 intervals between them.
    if (frames - 1) / fps > MAX_SPAN_S:
        raise Refused(
            f"{frames} frames at this rate last {(frames - 1) / fps:.6g} s, more than the {MAX_SPAN_S:.1f} s that an "
            "event file can hold",
            where="fps",
            value=fps,
            accepted=f"at least {(frames - 1) / MAX_SPAN_S:.4g}, or fewer frames",
        )
