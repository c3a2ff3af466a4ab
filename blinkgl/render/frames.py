"""Counters of the renderer."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class RenderStats:
    """Wall seconds since the renderer was made; triangles submitted after culling."""

    frames: int = 0
    triangles: int = 0
    render_s: float = 0.0
    readback_s: float = 0.0
