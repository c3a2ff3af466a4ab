"""The pictures of docs/light.md and docs/materials.md: one scene, each effect of light and surfaces added to what was
there before, a path tracer's (extra [cycles], see ``peer_cycles.py``) below it; a row of balls, each with one thing
more than a matt colour.

python -m blinkgl.tools.light_effects [--out docs/images/light.jpg] [--materials docs/images/materials.jpg]
"""

from __future__ import annotations

import argparse
from typing import Any

import cv2
import numpy as np

import blinkgl.scene.types as data
from blinkgl import Camera, Light, Material, Pose, Primitive, Scene, look_at
from blinkgl.camera import PinHole
from blinkgl.config.sequence import RenderConfig
from blinkgl.gl import GLContext, create_context
from blinkgl.render.renderer import Renderer
from blinkgl.scene.geometry.primitives import grid, sphere
from blinkgl.scene.motion.paths import StaticPath
from blinkgl.scene.rig import Rig
from blinkgl.tools.peer_cycles import CyclesSettings, colours

SIZE = 300, 225  # px of a panel, width and height
WHITE = 1.25  # radiance that is white in the picture: lamps shine on top of the sun
COLUMNS = 3
LAMPS = [
    {"kind": "point", "position": (-0.9, -1.4, 1.5), "strength": 0.9, "color": (1.0, 0.62, 0.36)},
    {
        "kind": "spot",
        "position": (1.0, 0.6, 3.4),
        "look_at": (0.9, -0.1, 0),
        "angle": 46,
        "edge": 0.1,
        "strength": 6.0,
        "size": 0.3,
    },
]
LOW_SUN = {"sun": 0.5, "sky": 0.45, "elevation": 32, "azimuth": 200}
COLOURED = {**LOW_SUN, "sun_color": (1.0, 0.82, 0.6), "sky_color": (0.65, 0.8, 1.0)}
LIT = {**COLOURED, "lights": LAMPS}
PANELS: list[tuple[str, dict[str, Any], tuple[str, ...]]] = [
    # Each has what those before it have: caption, light, effects of the surfaces
    ("nothing said", {}, ()),
    ("coloured sun and sky", COLOURED, ()),
    ("point and spot light", LIT, ()),
    ("hard shadows", {**LIT, "shadows": "hard"}, ()),
    ("soft shadows", {**LIT, "shadows": "soft", "sun_size": 6}, ()),
    ("metal and roughness", {**LIT, "shadows": "soft", "sun_size": 6}, ("gloss",)),
    ("a normal map", {**LIT, "shadows": "soft", "sun_size": 6}, ("gloss", "bumps")),
    ("light of its own", {**LIT, "shadows": "soft", "sun_size": 6}, ("gloss", "bumps", "glow")),
    ("holes", {**LIT, "shadows": "soft", "sun_size": 6}, ("gloss", "bumps", "glow", "holes")),
]


def scene(light: Light, effects: tuple[str, ...]) -> Scene:
    """A box, balls, a ring and a standing sheet on a plane."""
    bumps, opacity, _ = _waves()
    gold = {"metallic": 1.0, "roughness": 0.3} if "gloss" in effects else {}
    wet = {"roughness": 0.35} if "gloss" in effects else {}
    dents = {"normal_map": bumps} if "bumps" in effects else {}
    glow = {"emission": (0.25, 0.12, 0.4)} if "glow" in effects else {}
    holes = {"mask": opacity, "cutoff": 0.45} if "holes" in effects else {}
    lying = Pose((0.1, -1.25, 0.13), euler=(0, 0, 20))
    things = (
        Primitive("grid", category="ground", scale=14, material=Material(color=(0.62, 0.6, 0.57))),
        Primitive(
            "cuboid",
            pose=Pose((0.45, 1.3, 0.55), euler=(0, 0, 25)),
            scale=1.1,
            material=Material(procedural="bricks", color=(0.5, 0.85, 0.6), **dents),
        ),
        Primitive("sphere", pose=(1.15, -0.2, 0.75), scale=0.8, material=Material(color=(1.0, 0.77, 0.34), **gold)),
        Primitive("sphere", pose=(-1.6, 1.4, 0.6), scale=1.2, material=Material(color=(0.8, 0.35, 0.3), **wet)),
        Primitive("torus", pose=lying, scale=0.9, material=Material(color=(0.35, 0.3, 0.5), **glow)),
        Primitive(
            "grid",
            pose=Pose((-0.75, -0.15, 0.75), euler=(80, 0, -15)),
            scale=1.1,
            material=Material(color=(0.45, 0.6, 0.85), double_sided=True, **holes),
        ),
    )
    camera = Camera(*SIZE, fov=42, pose=look_at((0.3, -5.2, 2.6), (0.0, 0.2, 0.4)))
    return Scene(camera, things, light=light, background=0.32)


def shown(radiance: np.ndarray) -> np.ndarray:
    """(h, w, 3) uint8 BGR of linear radiance."""
    seen = np.clip(radiance / WHITE, 0, 1)
    return np.ascontiguousarray((255 * seen ** (1 / 2.2)).round().astype(np.uint8)[..., ::-1])


def labelled(picture: np.ndarray, caption: str) -> np.ndarray:
    """With a line above it."""
    bar = np.full((24, picture.shape[1], 3), 255, np.uint8)
    cv2.putText(bar, caption, (6, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (40, 40, 40), 1, cv2.LINE_AA)
    return np.concatenate([bar, picture])


def panels(gl: GLContext, samples: int) -> np.ndarray:
    """Each effect added to those before: ours above, Cycles below; and Cycles with all that it knows as the last."""
    pairs = []
    for number, (caption, light, effects) in enumerate(PANELS):
        described = scene(Light(**light), effects)
        made = described.build(described.template().sequence(0))
        with Renderer(gl, made, RenderConfig(image_antialiasing="ssaa4")) as renderer:
            ours = renderer.colour(0).read()
        settings = CyclesSettings(
            max(samples, 1), shadows=light.get("shadows", "off") != "off", occlusion=False, bounces=0
        )
        (theirs,) = colours(made, [0], settings) if samples else (np.ones_like(ours),)
        text = caption if number == 0 else f"+ {caption}"
        pairs.append(np.concatenate([labelled(shown(ours), text), labelled(shown(theirs), "Cycles, path depth 1")]))
    rows = [np.concatenate(pairs[k : k + COLUMNS], axis=1) for k in range(0, len(pairs), COLUMNS)]
    return np.concatenate(rows)


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


def row_of_balls(gl: GLContext) -> np.ndarray:
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
    with Renderer(gl, scene, RenderConfig(image_antialiasing="ssaa4")) as renderer:
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
    parser.add_argument("--samples", type=int, default=128, help="of Cycles, paths a pixel; 0: white in its place")
    options = parser.parse_args()
    with create_context() as gl:
        pages = {options.materials: row_of_balls(gl), options.out: panels(gl, options.samples)}
    for path, picture in pages.items():
        if not cv2.imwrite(path, picture, [cv2.IMWRITE_JPEG_QUALITY, 88]):
            parser.error(f"cannot write {path}")


if __name__ == "__main__":
    main()
