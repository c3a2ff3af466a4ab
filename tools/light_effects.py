"""The picture of docs/light.md: one scene, each kind of light added to what was there before.

python -m blinkgl.tools.light_effects [--out docs/images/light.jpg]
"""

from __future__ import annotations

import argparse
from typing import Any

import cv2
import numpy as np

from blinkgl import Camera, Light, Material, Pose, Primitive, Scene, look_at, render_frame

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="docs/images/light.jpg")
    options = parser.parse_args()
    panels = [panel(light, caption) for caption, light in PANELS.items()]
    if not cv2.imwrite(options.out, np.concatenate(panels, axis=1), [cv2.IMWRITE_JPEG_QUALITY, 90]):
        parser.error(f"cannot write {options.out}")


if __name__ == "__main__":
    main()
