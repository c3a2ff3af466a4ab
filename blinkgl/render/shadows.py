"""Shadow maps: what each lamp sees of the scene, and how a surface point is found in them.

A sun's map is a box of parallel light around everything that casts shadows at any time; outside it nothing is shaded.
It does not depend on the camera, so it stays while the camera moves. A spot light's map is a picture of its cone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from blinkgl.camera import PinHole
from blinkgl.render.moment import View
from blinkgl.scene.lights import lamps_of, shadowing
from blinkgl.scene.types import Lamp, Scene

if TYPE_CHECKING:
    from blinkgl.render.draw_items import DrawItem

CV_FROM_LAMP = np.diag([1.0, -1.0, -1.0, 1.0])
"""A lamp shines along its -z axis, a camera looks along its z axis with y down."""
_TIMES = 129  # number of times at which moving objects are sampled; their speed bounds them in between
_SPARE = 4  # texels on every side of a map
_NEAR = 0.02  # world units in front of a spot light in which nothing casts


class Parallel(NamedTuple):
    """A camera of parallel rays, for :class:`~blinkgl.render.moment.View`: sees |X| <= half_x, |Y| <= half_y, and 0 <=
    Z <= depth, on size x size texels."""

    size: int
    half_x: float
    half_y: float
    depth: float

    @property
    def width(self) -> int:
        return self.size

    @property
    def height(self) -> int:
        return self.size

    def clip_from_cam(self) -> np.ndarray:
        """Return clip_from_cam, (4, 4) float64; w = 1, depth 1 at Z = 0 and 0 at the far end."""
        return np.array(
            [
                [1 / self.half_x, 0, 0, 0],
                [0, 1 / self.half_y, 0, 0],
                # Reversed depth, 1 - Z / depth.
                [0, 0, -1 / self.depth, 1.0],
                [0, 0, 0, 1.0],
            ]
        )

    def bounds(self, points: np.ndarray) -> tuple[int, int, int, int] | None:
        """Return the texels that the convex hull of (n, 3) points can touch, as a camera model does."""
        x = (points[:, 0] / self.half_x + 1) * self.size / 2
        y = (points[:, 1] / self.half_y + 1) * self.size / 2
        # One texel of margin on each side for rounding; the upper ends are exclusive.
        x0, x1 = max(0, math.floor(x.min()) - 1), min(self.size, math.ceil(x.max()) + 2)
        y0, y1 = max(0, math.floor(y.min()) - 1), min(self.size, math.ceil(y.max()) + 2)
        return (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else None


@dataclass(frozen=True)
class Box:
    """The box of a sun's map. centre : (3,), world axes.   half : (3,) along the lamp's axes."""

    centre: tuple[float, float, float]
    half: tuple[float, float, float]


def boxes(scene: Scene, items: Sequence[DrawItem]) -> dict[int, Box | None]:
    """Return, for each sun among the lamps of :func:`shadowing`, by its number, the box around everything that casts;
    None for spot lights. Empty where nothing casts."""
    spheres = _swept(scene, items)
    if not len(spheres):
        return {}
    by_object: dict[int, Box | None] = {}
    lamps = lamps_of(scene.light)
    for k in shadowing(scene.light):
        by_object[k] = _box(lamps[k], spheres) if lamps[k].kind == "sun" else None
    return by_object


def _box(lamp: Lamp, spheres: np.ndarray) -> Box:
    centres, radius = spheres[:, :3], spheres[:, 3:]
    if lamp.path.is_static:
        R = (lamp.path.pose(0) @ CV_FROM_LAMP)[:3, :3]
        # Rows times R are in the lamp's axes.
        low, high = (centres @ R - radius).min(axis=0), (centres @ R + radius).max(axis=0)
        middle, half = R @ (low + high) / 2, (high - low) / 2
    else:  # for any direction
        low, high = (centres - radius).min(axis=0), (centres + radius).max(axis=0)
        middle = (low + high) / 2
        half = np.full(3, (np.linalg.norm(centres - middle, axis=1) + spheres[:, 3]).max())
    x, y, z = (float(v) for v in middle)
    a, b, c = (max(float(v), 1e-6) for v in half)
    return Box((x, y, z), (a, b, c))


def _swept(scene: Scene, items: Sequence[DrawItem]) -> np.ndarray:
    """Return (n, 4) centre and radius, world axes, of spheres that contain every casting item at all times."""
    times = np.linspace(scene.t0_ns, scene.t1_ns, _TIMES).astype(np.int64)
    spheres = []
    for item in items:
        if not item.casts:
            continue
        path = scene.objects[item.object_index].path
        poses = path.poses(times[:1] if path.is_static else times)
        centres = poses[:, :3, :3] @ item.centre + poses[:, :3, 3]
        room = item.radius
        if not path.is_static:
            speed, turning = path.speed_bound(scene.t0_ns, scene.t1_ns)
            step = (scene.t1_ns - scene.t0_ns) * 1e-9 / (_TIMES - 1)
            # Between two sampled times a sphere moves by at most half a step at its largest speed from the nearer one.
            room += 0.5 * step * (speed + turning * float(np.linalg.norm(item.centre)))
        spheres.append(np.column_stack([centres, np.full(len(centres), room)]))
    return np.concatenate(spheres) if spheres else np.zeros((0, 4))


def view_of(lamp: Lamp, box: Box | None, size: int, pose: np.ndarray) -> tuple[View, np.ndarray]:
    """Return the view of the lamp's map, and its pose T_world_cam, (4, 4). pose : T_world_lamp."""
    T = pose @ CV_FROM_LAMP
    if box is None:
        return View.of(PinHole.centred(size, size, 1 / _texel_of_cone(lamp, size), near=_NEAR)), T
    # The box is widened by _SPARE texels on every side of the map.
    x, y, z = (h * size / (size - 2 * _SPARE) for h in box.half)
    camera = Parallel(size, x, y, 2 * z)
    # The camera of the map stands on the side of the box that faces the lamp.
    T[:3, 3] = np.asarray(box.centre) - z * T[:3, 2]
    # No sphere is outside these planes, which go through one point: every casting item is drawn.
    return View(camera, camera.clip_from_cam(), np.zeros((1, 3))), T


@lru_cache(maxsize=64)
def scale_of(lamp: Lamp, box: Box | None, size: int) -> tuple[float, float, float, float]:
    """Return ``shadow_scale`` of shadows.glsl."""
    # x + y times the depth is the width of a texel, z the depth in the map of a world unit, w the size of the lamp.
    camera = view_of(lamp, box, size, np.eye(4))[0].camera
    if isinstance(camera, Parallel):
        return 2 * max(camera.half_x, camera.half_y) / camera.size, 0.0, 1 / camera.depth, lamp.size
    return 0.0, _texel_of_cone(lamp, size), 0.0, lamp.size


def _texel_of_cone(lamp: Lamp, size: int) -> float:
    """Return the width of a texel of a spot light's map at a depth of 1."""
    # A cone of 90 degrees has no flat picture, so 1.5 rad is the widest.
    return math.tan(min(lamp.outer, 1.5)) / (size / 2 - _SPARE)


def planes_of(rows: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Return ``shadow_plane`` of shadows.glsl, (maps, 3, 3). The depth of a plane with normal n is affine in the map;
    its slopes along x and y are the first two rows times n, divided by the third times n (for a spot light in the
    shader), times the depth of a world unit. rows, scales : (maps, 4, 4), (maps, 4) as in the shader."""
    across = rows[:, :2, :3] - 0.5 * rows[:, 3:, :3]  # without the centring of a perspective map
    across = across / (across**2).sum(axis=2, keepdims=True)
    along = rows[:, 2:3, :3] / -np.where(scales[:, 2] > 0, scales[:, 2], 1.0)[:, None, None]
    return np.concatenate([across, along], axis=1)
