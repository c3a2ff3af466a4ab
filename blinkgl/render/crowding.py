"""Scenes whose outlines crowd: where several surfaces share many pixels, or masks cut holes, lines alone do not say
what a pixel shows, and filtering them invents events. Such a scene is drawn with samples (docs/trade.md)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from blinkgl.render.draw_items import SKY

if TYPE_CHECKING:
    from blinkgl.render.contours import Lines
    from blinkgl.render.draw_items import DrawItem
    from blinkgl.render.moment import Moment

_CROWDED_AS = {"edges": "ssaa4", "edges2": "ssaa8"}
"""Anti-aliasing of such a scene: at equal cost ``ssaa4`` has less error there than either, and what ``edges2`` is asked
for, less error than ``edges``, takes more samples."""
_LARGEST = 2**20, 2048
"""Pixels of a picture, and of one side, up to which 8 x 8 samples fit the memory and the textures of every OpenGL."""
_TANGLED, _HOLED = 0.03, 0.03
"""Shares of the picture from which on outlines crowd: pixels with the lines of several surfaces, and masked surfaces.
Scenes that ``edges`` draws well have at most 0.025 tangled pixels, those that it draws badly 0.05 and more."""


def crowded_as(antialiasing: str, width: int, height: int) -> str:
    """Return the anti-aliasing that a crowded scene has in place of ``edges`` or ``edges2``, in a picture of this size,
    px."""
    fits = width * height <= _LARGEST[0] and max(width, height) <= _LARGEST[1]
    return _CROWDED_AS[antialiasing] if fits else _CROWDED_AS["edges"]


def crowding(moments: Sequence[Moment], lines: Lines, width: int, height: int) -> str:
    """Return why a scene is drawn with samples, in words; "" where its lines suffice.

    moments : some, of the whole sequence.   lines : of its contours.   width, height : of the picture, px."""
    size = width, height
    bodies = [_outlined(moment) for moment in moments]
    holed = np.mean([_masked(moment, items, *size) for moment, items in zip(moments, bodies)])
    if holed >= _HOLED:
        return f"masked surfaces fill {100 * holed:.0f} % of the picture"
    tangled = np.mean([lines.tangled(moment, items, *size) for moment, items in zip(moments, bodies)])
    return f"outlines of several surfaces cross in {100 * tangled:.0f} % of the pixels" if tangled >= _TANGLED else ""


def _outlined(moment: Moment) -> list[DrawItem]:
    """Return what is drawn with its outlines: neither the sky nor a body under a pixel."""
    specks = set(moment.specks(1, len(moment.T_world_obj))[0].tolist())
    return [item for item in moment.visible if item.layer != SKY and item.object_index not in specks]


def _masked(moment: Moment, items: list[DrawItem], width: int, height: int) -> float:
    """Return the area of masked surfaces before the camera as a share of the picture's, at most 1: their triangles',
    of which all corners are in front of it, hidden ones included."""
    area = 0.0
    for item in items:
        mask = item.material.mask
        if mask is None or mask.alpha.min() >= 255 * mask.threshold:  # exporters give masks to what has no hole
            continue
        vertices = item.mesh.vertices
        clip = vertices @ moment.mvp[item.object_index][:, :3].T + moment.mvp[item.object_index][:, 3]
        ahead = np.all(clip[item.mesh.faces, 3] > moment.view.camera.near, axis=1)
        # Beyond the picture's edges there is no area.
        flat = np.clip(clip[:, :2] / np.where(clip[:, 3:] > 0, clip[:, 3:], 1.0), -1.0, 1.0)
        a, b, c = np.moveaxis(flat[item.mesh.faces[ahead]], 1, 0)
        u, v = b - a, c - a
        # NDC has an area of 4.
        area += 0.125 * float(np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum())
    return min(area, 1.0)
