"""The pictures of docs/light.md and docs/materials.md: one scene, each kind of light added to what was there before; a
row of balls, each with one thing more than a matt colour.

python -m blinkgl.tools.light_effects [--out docs/images/light.jpg] [--materials docs/images/materials.jpg]
"""

from __future__ import annotations

import argparse
from typing import Any

import cv2
import numpy as np

import blinkgl.scene.types as data
from blinkgl import Camera, Light, Material, Pose, Primitive, Scene, look_at, render_frame
from blinkgl.camera import PinHole
from blinkgl.config.sequence import RenderConfig
from blinkgl.gl import create_context
from blinkgl.render.renderer import Renderer
from blinkgl.scene.geometry.primitives import grid, sphere
from blinkgl.scene.motion.paths import StaticPath
from blinkgl.scene.rig import Rig

SIZE = 300, 260  # px of a panel, width and height
WHITE = 1.25  # radiance that is white in the picture: lamps shine on top of the sun
LAMPS = [
    {"kind": "point", "position": (-0.9, -1.4, 1.5), "strength": 0.9, "color": (1.0, 0.62, 0.36)},
    {
        "kind": "spot",
        "position": (1.0, 0.6, 3.4),
        "look_at": (0.9, -0.1, 0),
        "angle": 46,
        "edge": 0.3,
        "strength": 6.0,
        "size": 0.5,
    },
]
LOW_SUN = {"sun": 0.5, "sky": 0.45, "elevation": 32, "azimuth": 200}
COLOURED = {**LOW_SUN, "sun_color": (1.0, 0.82, 0.6), "sky_color": (0.65, 0.8, 1.0)}
PANELS: dict[str, dict[str, Any]] = {
    "nothing said": {},
    "coloured sun and sky": COLOURED,
    "point and spot light": {**COLOURED, "lights": LAMPS},
    "hard shadows": {**COLOURED, "lights": LAMPS, "shadows": "hard"},
    "soft shadows": {**COLOURED, "lights": LAMPS, "shadows": "soft", "sun_size": 8},
}


def scene(light: Light) -> Scene:
    """A person, a box, two balls, one of which floats, on a plane."""
    things = (
        Primitive("grid", category="ground", scale=14, material=Material(color=(0.62, 0.6, 0.57))),
        Primitive("figure", pose=Pose((-0.55, 0.0, 0.0), euler=(0, 0, -80)), variant=3, coat=5, clip="wave"),
        Primitive("cuboid", pose=(0.35, 1.5, 0.5), material=Material(procedural="bricks", color=(0.5, 0.85, 0.6))),
        Primitive("sphere", pose=(0.95, -0.15, 0.75), scale=0.5),
        Primitive("sphere", pose=(-1.6, 1.7, 0.6), scale=1.0, material=Material(color=(0.8, 0.35, 0.3))),
    )
    camera = Camera(*SIZE, fov=36, pose=look_at((0.3, -5.2, 2.6), (0.1, 0.3, 0.45)))
    return Scene(camera, things, light=light, background=0.32)


def panel(light: dict[str, Any], caption: str) -> np.ndarray:
    """(h, w, 3) uint8 BGR."""
    seen = np.clip(render_frame(scene(Light(**light)), 0.2).images / WHITE, 0, 1)
    picture = np.ascontiguousarray((255 * seen ** (1 / 2.2)).round().astype(np.uint8)[..., ::-1])
    bar = np.full((26, SIZE[0], 3), 255, np.uint8)
    cv2.putText(bar, caption, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (40, 40, 40), 1, cv2.LINE_AA)
    return np.concatenate([bar, picture])


def _waves(size: int = 128) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A normal map of dimples, opacity of a lattice, roughness in stripes; uint8."""
    y, x = np.mgrid[0:size, 0:size] / size * 2 * np.pi
    slope = np.stack([np.cos(4 * x) * np.sin(4 * y), np.sin(4 * x) * np.cos(4 * y), np.full_like(x, 1.2)], axis=-1)
    normals = slope / np.linalg.norm(slope, axis=-1, keepdims=True)
    rough = np.stack([0 * x, 0.45 + 0.35 * np.sign(np.sin(6 * y)), 1 + 0 * x], axis=-1)
    opacity = 0.5 + 0.5 * np.sin(4 * x) * np.sin(4 * y) + 0.1
    return tuple(np.clip(255 * v, 0, 255).round().astype(np.uint8) for v in (0.5 + 0.5 * normals, opacity, rough))


def balls() -> dict[str, data.Material]:
    """By caption."""
    bumps, opacity, rough = _waves()
    red, gold, repeats = (0.7, 0.12, 0.1), (1.0, 0.77, 0.34), (4.0, 2.0)
    maps = {name: data.Map(data.Texture(image)) for name, image in (("bumps", bumps), ("rough", rough))}
    return {
        "matt": data.Material(base_color=red),
        "roughness 0.5": data.Material(base_color=red, gloss=data.Gloss(0, 0.5)),
        "roughness 0.15": data.Material(base_color=red, gloss=data.Gloss(0, 0.15)),
        "metal, 0.5": data.Material(base_color=gold, gloss=data.Gloss(1, 0.5)),
        "metal, 0.2": data.Material(base_color=gold, gloss=data.Gloss(1, 0.2)),
        "roughness map": data.Material(base_color=gold, gloss=data.Gloss(1, 1, maps["rough"])),
        "normal map": data.Material(base_color=red, gloss=data.Gloss(0, 0.3), bumps=maps["bumps"], uv_scale=repeats),
        "light of its own": data.Material(base_color=(0.1, 0.1, 0.1), emission=(0.5, 0.9, 0.6)),
        "holes": data.Material(base_color=(0.3, 0.5, 0.8), mask=data.Mask(opacity), uv_scale=repeats),
    }


def row_of_balls() -> np.ndarray:
    """(h, w, 3) uint8 BGR."""
    made, width, height = balls(), 1500, 240
    ball, floor = sphere(segments=64, rings=32), grid(width=40.0, depth=14.0)
    things = [data.SceneObject("floor", 1, (data.Part(floor, data.Material(base_color=(0.6,) * 3)),), StaticPath())]
    for k, material in enumerate(made.values()):
        place = np.eye(4)
        place[:3, 3] = 1.25 * (k - (len(made) - 1) / 2), 0.0, 0.5
        things.append(data.SceneObject(f"{k}", k + 2, (data.Part(ball, material),), StaticPath(place)))
    sun = data.Light(sun_direction=(-0.48, -0.6, 0.64), sun=0.6, sky=0.5, sky_color=(0.8, 0.9, 1.0), shadows="hard")
    eye, ahead = np.eye(4), np.array([0.0, 16.0, -2.78]) / np.hypot(16.0, 2.78)
    eye[:3, :3] = np.stack([[1.0, 0, 0], np.cross(ahead, [1.0, 0, 0]), ahead], axis=1)  # x right, y down
    eye[:3, 3] = 0, -16.0, 3.2
    camera = PinHole.centred(width, height, 2000.0, near=0.1)
    scene = data.Scene(tuple(things), Rig.alone(camera, StaticPath(eye)), 0, 1_000_000, sun, 0.5)
    with create_context() as gl, Renderer(gl, scene, RenderConfig(image_antialiasing="ssaa4")) as renderer:
        seen = np.clip(renderer.colour(0).read(), 0, 1)
    picture = np.ascontiguousarray((255 * seen ** (1 / 2.2)).round().astype(np.uint8)[..., ::-1])
    bar = np.full((26, width, 3), 255, np.uint8)
    for k, caption in enumerate(made):
        middle = width / 2 + 2000.0 / 16.3 * 1.25 * (k - (len(made) - 1) / 2)
        (wide, _), _ = cv2.getTextSize(caption, cv2.FONT_HERSHEY_SIMPLEX, 0.45, 1)
        cv2.putText(
            bar, caption, (int(middle - wide / 2), 18), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (40,) * 3, 1, cv2.LINE_AA
        )
    return np.concatenate([bar, picture])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="docs/images/light.jpg")
    parser.add_argument("--materials", default="docs/images/materials.jpg")
    options = parser.parse_args()
    if not cv2.imwrite(options.materials, row_of_balls(), [cv2.IMWRITE_JPEG_QUALITY, 90]):
        parser.error(f"cannot write {options.materials}")
    panels = [panel(light, caption) for caption, light in PANELS.items()]
    if not cv2.imwrite(options.out, np.concatenate(panels, axis=1), [cv2.IMWRITE_JPEG_QUALITY, 90]):
        parser.error(f"cannot write {options.out}")


if __name__ == "__main__":
    main()
