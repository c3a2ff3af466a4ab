"""Small skeletons and skins for tests: an arm of two bones, a bar that follows it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from blinkgl.scene.geometry import BUILDERS
from blinkgl.scene.shapes.skeleton import Locals, Skeleton
from blinkgl.scene.shapes.skin import Skin


class Swinging:
    """A formula: every joint swings about an axis, the first one also slides and breathes."""

    period_ns = span_ns = 1_000_000_000
    timescale_ns = 50_000_000
    is_static = False

    def __init__(self, count: int = 2, angle: float = 0.8):
        self.count, self.angle = count, angle

    def locals(self, t_ns: int) -> Locals:
        out = Locals.rest(self.count)
        w = 2 * math.pi
        phase = w * (t_ns % self.period_ns) * 1e-9
        for i in range(self.count):
            half = 0.5 * self.angle * math.sin(phase + i)
            rate = 0.5 * self.angle * w * math.cos(phase + i)
            axis = np.array([[0.0, 1.0, 0.0], [0.6, 0.8, 0.0]][i % 2])
            out.rotation[i] = [*(math.sin(half) * axis), math.cos(half)]
            out.d_rotation[i] = [*(math.cos(half) * rate * axis), -math.sin(half) * rate]
            out.translation[i, 2] = i > 0
        out.translation[0, 0], out.d_translation[0, 0] = 0.2 * math.sin(phase), 0.2 * w * math.cos(phase)
        out.scale[0], out.d_scale[0] = [1, 1 + 0.2 * math.sin(phase), 1], [0, 0.2 * w * math.cos(phase), 0]
        return out


def arm(**bar):
    """A bar 0.4 x 0.4 x 2 from z = 0 upwards, that follows two bones, the second from z = 1 on."""
    mesh = BUILDERS["cuboid"](extents=(0.4, 0.4, 2.0), subdivisions=6, **bar)
    mesh = replace(mesh, vertices=mesh.vertices + [0, 0, 1])
    up = np.clip((mesh.vertices[:, 2] - 0.7) / 0.6, 0, 1)
    skeleton = Skeleton([-1, 0], Swinging())
    bind = np.tile(np.eye(4), (2, 1, 1))
    bind[1, 2, 3] = -1.0
    joints = np.tile([0, 1], (len(up), 1))
    return replace(mesh, deformer=Skin(skeleton, [0, 1], bind, joints, np.stack([1 - up, up], axis=1)))
