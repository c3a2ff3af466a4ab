"""``deform:`` on the parts of one object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from blinkgl.config.deform import DeformConfig
from blinkgl.scene.geometry.meshes import bounds, finer
from blinkgl.scene.shapes.table import deformer_of
from blinkgl.scene.types import Part

EDGE = 1 / 12
"""Of the object's longest side: longer edges are split, so that a box can bend."""


def deforming(parts: Sequence[Part], config: DeformConfig) -> tuple[Part, ...]:
    """The parts of one object, whose shape changes together as ``deform:`` says; their triangles as fine as that
    takes."""
    low, high = bounds([part.mesh for part in parts])
    deformer, edge = deformer_of(config, low, high), EDGE * float(np.max(high - low))
    return tuple(replace(part, mesh=replace(finer(part.mesh, edge), deformer=deformer)) for part in parts)
