"""``frames:`` section: sequences converted from recorded or rendered frames, such as TartanAir's, instead of from a scene."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from blinkgl.config.base import Config
from blinkgl.config.scene import Paths


class FramesConfig(Config):
    """Frames of a folder through the event emulator; a flow file per pair of frames becomes the label."""

    folders: Paths = Field((), description="folders of one sequence each, or patterns such as `/data/tartanair/*/*/P0*`; sequence n takes "
                           "the n-th in alphabetical order")
    images: str = Field("image_left", description="sub-folder of the images, or '.'")
    flow: str | None = Field("flow", description="sub-folder of the optical flow, one file per pair of frames in their order: .npy "
                             "(H, W, 2 or 3), .flo or DSEC .png; null: none")
    fps: float = Field(10.0, gt=0, le=1e6, description="frames per second that the frames are taken to have, Hz; flow labels come at this rate")
    first: int = Field(0, ge=0, description="frames left out at the beginning")
    count: int | None = Field(None, ge=3, description="frames used; null: all")
    gamma: Literal["srgb", "linear"] = Field("srgb", description="transfer curve of the images")
    interpolate: Literal["linear", "cubic", "motion"] = Field("motion", description="between frames: as `blinkgl simulate --interpolate`")
    max_px: float = Field(1.0, gt=0, le=1e3, description="motion: largest displacement per step, px")
    factor: int = Field(4, ge=1, le=1000, description="cubic: steps per given frame")
