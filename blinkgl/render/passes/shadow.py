"""Shadow maps: passes drawn before those that use their light."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from moderngl import LINEAR

from blinkgl.render.frames import DEPTH_BUFFER
from blinkgl.render.moment import Moment
from blinkgl.render.passes.base import Input, Output, Pass, ScenePass, Shot
from blinkgl.render.shadows import Box, boxes, planes_of, scale_of, view_of
from blinkgl.scene.lights import MAX_SHADOWS, lamps_of
from blinkgl.scene.motion.paths import StaticPath
from blinkgl.scene.types import Lamp, Scene

if TYPE_CHECKING:
    from blinkgl.gl.shader import Uniforms
    from blinkgl.render.draw_items import DrawItem, Kind
    from blinkgl.render.painter import Painter


FINEST = 1 / 32
"""Required depth resolution, in widths of a texel. The comparison is offset by a quarter of one or more."""


@dataclass(frozen=True)
class ShadowMap(ScenePass):
    """Depth buffer of what casts a lamp's shadows, (texels, texels), reversed: 0 where nothing does. It is redrawn only
    where a caster has moved.

    box : of a sun.   soft : whether its readers use the depths themselves.
    crowd : whether most casters move, so that all are redrawn."""

    lamp: Lamp
    box: Box | None
    texels: int
    soft: bool = False
    crowd: bool = False
    program: ClassVar[str] = "shadow.glsl"
    outputs: ClassVar[tuple[Output, ...]] = ()
    common: ClassVar[bool] = True

    def size(self, width: int, height: int) -> tuple[int, int]:
        return self.texels, self.texels

    @property
    def depth(self) -> str:
        """Return the depth format: half the memory where that is exact to a fraction of a texel, as for a sun, whose
        steps are equal."""
        if self.box is None:
            return "texture"
        # 16 bits resolve 1/65535 of the map's depth.
        step = view_of(self.lamp, self.box, self.texels, np.eye(4))[0].camera.depth / 65535
        return "texture of 16 bits" if step < FINEST * scale_of(self.lamp, self.box, self.texels)[0] else "texture"

    def stands_still(self, whole: bool) -> bool:
        """Return whether the lamp stands still; the camera does not matter."""
        return self.lamp.path.is_static and not self.crowd

    def defines(self, kind: Kind | None) -> dict[str, object]:
        return {"PARALLEL": 1} if self.lamp.kind == "sun" else {}

    def seen(self, moment: Moment) -> Moment:
        return moment.from_place(*view_of(self.lamp, self.box, self.texels, self.lamp.path.pose(moment.t_ns)))

    def items(self, moment: Moment) -> list[DrawItem]:
        return [item for item in moment.visible if item.casts]

    @classmethod
    def every_kind(cls) -> Iterator[Pass]:
        white = (1.0, 1.0, 1.0)
        yield cls(Lamp("sun", white, StaticPath()), Box((0.0, 0.0, 0.0), white), 64)
        yield cls(Lamp("spot", white, StaticPath()), None, 64)


def shadow_maps(scene: Scene, items: Sequence[DrawItem]) -> tuple[ShadowMap, ...]:
    """Return the maps of the scene's light, suns first; none where there are no shadows or no casters."""
    lamps, light = lamps_of(scene.light), scene.light
    # The cost of moving casters is their area, which must be restored; that of static ones their triangles.
    moving, standing = ([i for i in items if i.casts and i.moves == moves] for moves in (True, False))
    room = sum(i.radius**2 for i in moving)
    crowd = bool(moving) and room > sum(i.radius**2 for i in standing) and _faces(standing) <= _faces(moving)
    return tuple(
        ShadowMap(lamps[k], box, light.shadow_size, light.shadows == "soft", crowd)
        for k, box in boxes(scene, items).items()
    )


def _faces(items: Iterable[DrawItem]) -> int:
    return sum(len(item.mesh.faces) for item in items)


class Shaded(ScenePass):
    """A lit pass. shadows : maps of the lamps whose shadows it draws, a field of the pass."""

    lit: ClassVar[bool] = True
    shadows: tuple[ShadowMap, ...]

    @property
    def inputs(self) -> tuple[Input, ...]:
        return tuple(Input(name, map_, DEPTH_BUFFER) for name, map_ in zip(_SAMPLERS, self.shadows))

    @property
    def depth(self) -> bool | str:
        return "texture" if self.samples.edges else True

    def bind(self, uniforms: Uniforms, shot: Shot) -> None:
        for unit, (name, map_) in enumerate(zip(_SAMPLERS, self.shadows), 1):
            if name in uniforms:
                texture = shot.inputs[name].texture(DEPTH_BUFFER)
                # The sampler compares, filtered over four texels: 1 where the surface is at least as near as
                # the map's depth.
                if not map_.soft and texture.compare_func != ">=":
                    texture.compare_func, texture.filter = ">=", (LINEAR, LINEAR)
                texture.use(unit)
                uniforms[name].value = unit

    def set(self, painter: Painter, uniforms: Uniforms, item: DrawItem, shot: Shot) -> None:
        if "shadow_rows" in uniforms:
            seen = [shot.inputs[name].moment for name, _ in zip(_SAMPLERS, self.shadows)]
            # From the object's axes into each map's texture.
            rows = np.stack([moment.texture_from_obj[item.object_index] for moment in seen])
            uniforms["shadow_rows"].write(rows.tobytes())
            uniforms["shadow_scale"].write(_scales(self.shadows).tobytes())
            if "facet_slope" in uniforms:
                uniforms["facet_slope"].value = item.facet_slope
            if "shadow_plane" in uniforms:
                uniforms["shadow_plane"].write(planes_of(rows, _scales(self.shadows)).astype(np.float32).tobytes())


_SAMPLERS = tuple(f"shadow_map_{k}" for k in range(MAX_SHADOWS))


@lru_cache(maxsize=64)
def _scales(maps: tuple[ShadowMap, ...]) -> np.ndarray:
    """Return ``shadow_scale`` of shadows.glsl, (maps, 4) float32."""
    return np.array([scale_of(one.lamp, one.box, one.texels) for one in maps], np.float32)
