"""Which scene, and when: the frames that are written down, as key frames that Blender itself has evaluated."""

from __future__ import annotations

from dataclasses import dataclass
from math import gcd

import bpy
from said import Refused, names

_MOST_FRAMES = 100_000


def choose_scene(name: str | None) -> bpy.types.Scene:
    """The scene of that name, else the one that the file was saved in."""
    if name is not None:
        if name not in bpy.data.scenes:
            raise Refused(f"the file has no scene '{name}'", accepted=f"one of: {names(bpy.data.scenes, 20)}")
        bpy.context.window.scene = bpy.data.scenes[name]
    return bpy.context.scene


@dataclass(frozen=True)
class Clock:
    """Frames as the exporter counts them: ``per`` of them are one of the file's."""

    first: int
    last: int
    per: int
    fps: float

    def all(self) -> list[int]:
        """Every frame that is written down."""
        return list(range(self.first, self.last + 1))

    def some(self, count: int) -> list[int]:
        """The first, the last and others between them."""
        return sorted({round(self.first + k * (self.last - self.first) / (count - 1)) for k in range(count)})

    def said(self) -> dict:
        """first, last: frames of the file; fps: of the file; duration_s: of the animation."""
        return {
            "first": self.first // self.per,
            "last": self.last // self.per,
            "fps": self.fps / self.per,
            "duration_s": (self.last - self.first) / self.fps,
        }


def set_clock(scene: bpy.types.Scene, frames: list[int] | None, per: int) -> Clock:
    """Sets the scene to ``per`` key frames per frame: its time is stretched and its frames come faster by as much."""
    first, last = frames or (scene.frame_start, scene.frame_end)
    if last < first or (last - first) * per > _MOST_FRAMES:
        raise Refused(
            f"frames {first} to {last} cannot be written down", accepted=f"--frames FIRST LAST, at most {_MOST_FRAMES}"
        )
    render = scene.render
    if per > 1:
        common = gcd(render.frame_map_old, render.frame_map_new)
        old, new = render.frame_map_old // common, render.frame_map_new // common * per
        if new > 900 or render.fps * per > 32767:
            raise Refused(f"{per} keys per frame are too many for this scene", accepted="fewer")
        render.frame_map_old, render.frame_map_new = old, new
        render.fps *= per
    scene.frame_start, scene.frame_end = first * per, last * per
    return Clock(first * per, last * per, per, render.fps / render.fps_base)
