"""``render.lod``: how many triangles a sequence needs."""

from __future__ import annotations

from pydantic import Field

from blinkgl.config.base import Config


class LodConfig(Config):
    """Level of detail: meshes are decimated until their triangles are not far below a pixel. The level is chosen once
    per object and sequence, from the nearest the object comes; frames and labels use the same meshes."""

    enabled: bool = Field(False, description="false: every mesh as it is")
    edge_px: float = Field(
        8.0,
        ge=0.1,
        le=1000,
        description="edges are at most this long in the image (in the mean over a mesh, where it is nearest), px",
    )
    error_px: float = Field(
        0.5,
        gt=0,
        le=100,
        description="a mesh is not decimated further than this: distance of its surface, and of the texture on it, px",
    )
