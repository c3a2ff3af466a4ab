"""``gl:`` section: which OpenGL implementation renders."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from blinkgl.config.base import Config


class GLConfig(Config):
    """Where the OpenGL context comes from (see :func:`blinkgl.gl.create_context`)."""

    backend: Literal["auto", "egl", "osmesa"] = Field(
        "auto", description="auto: EGL, and OSMesa (software) when EGL is missing; egl or osmesa: that one or an error"
    )
    device: int = Field(
        0, ge=0, description="number of the EGL device as `blinkgl doctor` lists them; without meaning for osmesa"
    )
