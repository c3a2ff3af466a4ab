"""Make ``tests/golden/cycles_light.npz``: what Blender's path tracer Cycles makes of the scenes of
tests/render/lit_cases.py.

    python tools/cycles_light.py OUT.npz [--only NAME] [--panoramas FOLDER] [--paths 32]

Every case that ``--only`` does not leave out is drawn at path depth 1; hours in all, seconds for one with few paths.
Blender's Python module ``bpy`` is GPL and needs NumPy 1: it is never imported here. The scene is written to a folder as
plain files (:func:`export`), and ``tools/cycles_trace.py`` renders it in a process of its own.

The same picture, as far as two renderers can make it:

* Geometry, shading normals, texture coordinates, poses and camera are converted, not approximated; Blender keeps them
  in float32, so the scene is moved to the first camera's place. Textures are handed over as linear float32, so no
  transfer curve is involved, filtered bilinearly without mip maps; the pixel is the mean
  over its square (box filter of 1 px).
* The sun is a lamp without extent, the sky a dome that is white above the horizon and black below: unobstructed,
  exactly ``sun * max(0, n.s) + sky * (0.5 + 0.5 n_z)``. Obstructed it is not what BlinkGL draws: that is the
  measurement. ``shadows=False, bounces=0`` is BlinkGL's own light model (the sky is evaluated, so nothing is noisy);
  ``shadows=True, occlusion=False`` adds shadows of the lamps, which is BlinkGL's with ``light.shadows``; ``bounces=0``
  adds those of the dome; ``bounces > 0`` adds inter-reflection. A panorama is the picture that BlinkGL found its
  harmonics in, its suns lamps.
* A gloss is Blender's principled surface with multiple scattering, which mirrors the world and the lamps alone; normal
  maps, light of its own, holes and colours of vertices are nodes of their own.
* Fog is an even volume that swallows and sends, for rays of the camera alone: BlinkGL's formula is the light's way from
  the surface to the camera, and leaves out that from the lamps to the surface.
* A thin lens, and an exposure (global shutter, bodies and camera moving between ``KEYS`` poses as Blender interpolates
  them), where settings ask for them: the frame camera's defocus and motion blur.
* Sky boxes are pictures: the camera sees them, light passes through them. Other unlit surfaces cast shadows but do not
  shine on anything, as in BlinkGL. Back faces of closed one-sided meshes are invisible to the camera alone.
* What stays different: shading normals that point away from the side that is lit are treated more strictly by a path
  tracer (dark terminators on coarse smooth meshes), the picture ends at a far plane (1e8 units), and a path-traced
  frame is noisy: the same seed in every frame keeps the noise of still surfaces still.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.blender.process import Blender, how_it_ended, interpreter
from blinkgl.camera import PinHole
from blinkgl.config.images import ImagesConfig, LensConfig
from blinkgl.errors import BlinkGLError
from blinkgl.render.colour import linear_image
from blinkgl.scene.lights import lamps_of, seen_around
from blinkgl.scene.types import Material, Scene

REPOSITORY = Path(__file__).parents[1]
KEYS = 17
"""Poses of what moves, from the beginning of an exposure to its end."""
# OpenCV's camera looks along +z with y down, Blender's along -z with y up.
CV_FROM_BLENDER = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class CyclesSettings:
    """samples : paths per pixel.   seed : of all frames.   shadows : of sun and dome; False needs bounces=0.
    occlusion : of the dome by what stands around; False needs bounces=0.   bounces : of diffuse light.   threads : 0
    for all.   lens : of ``images``; None: a pin-hole.   exposure_ns : from each frame's time on; 0: an instant."""

    samples: int = 64
    seed: int = 0
    shadows: bool = True
    occlusion: bool = False
    bounces: int = 0
    threads: int = 0
    lens: LensConfig | None = None
    exposure_ns: int = 0


def main() -> int:
    """Draw the cases and write them; return the exit status."""
    sys.path[:0] = [str(REPOSITORY), str(REPOSITORY / "tests" / "render")]
    cases = import_module("lit_cases").cases

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", default="")
    parser.add_argument("--panoramas", type=Path)
    parser.add_argument("--paths", type=int, default=4096)
    options = parser.parse_args()
    made: dict[str, Any] = {}
    for case in cases(options.panoramas):
        if options.only in case.name:
            images = None if case.images is None else ImagesConfig(**case.images, times=(0.0,))
            # A microsecond is an instant.
            open_ns = 0 if images is None or images.exposure_us <= 1 else int(1e3 * images.exposure_us)
            lens = None if images is None else images.lens
            settings = CyclesSettings(options.paths, shadows=case.shadows, lens=lens, exposure_ns=open_ns)
            made[case.name] = colours(case.scene, [0], settings)[0].astype(np.float16)
            print(case.name, flush=True)
    np.savez_compressed(options.out, **made)
    return 0


def colours(scene: Scene, times_ns: Iterable[int], settings: CyclesSettings = CyclesSettings()) -> list[np.ndarray]:
    """Return the linear radiance at each time, (H, W, 3) float32. Raises BlinkGLError: no bpy, or Blender stopped."""
    times_ns, made = np.array(list(times_ns), np.int64), []
    with tempfile.TemporaryDirectory(prefix="blinkgl-cycles-") as name:
        folder = Path(name)
        export(scene, times_ns, settings, folder)
        with Blender(REPOSITORY / "tools" / "cycles_trace.py", folder) as blender:
            for words in blender.answers():
                if "frame" in words:
                    made.append(np.load(folder / f"{words['frame']:06d}.npy", allow_pickle=False))
            status = blender.status()
            if status or len(made) < len(times_ns):
                ended = f"Blender {how_it_ended(status)} after {len(made)} frames: {blender.last_words()}"
                raise BlinkGLError(ended, where=interpreter())
    return made


def export(scene: Scene, times_ns: Iterable[int], settings: CyclesSettings, folder: Path) -> None:
    """Writes job.json and job.npz, all that the worker reads. World axes are the scene's (z up in
    both), its origin the first camera's place.

    job.json: size [W, H]; blender_camera, near; background; light {sun_direction, sun, sky, sky_color, lamps [{kind,
    strength, size, outer, blend}], which are the sun, too, unless the light is plain}; settings; lens [diameter, focus]
    and fog [density, radiance] or null; frames;
    materials [{texture index or null, base_color, unlit, culled, tinted, gloss [metallic, roughness] or null, bumps
    index or null, bump_scale, emission, alpha index or null, threshold}]; bodies [{name, picture_only, parts [[mesh,
    material], …]}]. job.npz, k counting what job.json refers to: vertices{k} (V, 3), normals{k} (V, 3), uvs{k} (V, 2)
    float32 with uv_scale in them and v growing upwards, colours{k} (V, 3) where vertices have them, faces{k} (F, 3)
    int32; texture{k} (h, w, 3) float32, linear or numbers, row 0 at the top; panorama (h, w, 3) float32, where one
    lights the scene; poses (bodies, N, 4, 4) and camera_poses (N, 4, 4), lamp_poses (lamps, N, 4, 4) float64, the
    camera's in Blender's camera axes; exposed (bodies and the camera, N, KEYS, 4, 4), where there is an exposure.
    Blender's spot lights fade otherwise between the inner and the outer angle.
    """
    if not isinstance(scene.camera, PinHole):
        raise BlinkGLError("the path tracer knows no lenses with distortion", where="camera", accepted="a pin-hole")
    times_ns = np.array(list(times_ns), np.int64)
    camera, arrays = scene.camera, {}
    meshes, materials, textures = _Numbered(), _Numbered(), _Numbered()
    bodies, paints = [], []
    for body in scene.objects:
        parts = []
        for part in body.parts:
            mesh, paint = part.mesh, part.material
            culled = part.culled
            k, new = meshes.number((id(mesh), paint.uv_scale))
            if new:
                arrays[f"vertices{k}"] = mesh.vertices.astype(np.float32)
                arrays[f"normals{k}"] = mesh.normals.astype(np.float32)
                arrays[f"faces{k}"] = mesh.faces.astype(np.int32)
                arrays[f"uvs{k}"] = _blender_uvs(mesh.uvs, paint.uv_scale)
                if mesh.colours is not None:
                    arrays[f"colours{k}"] = mesh.colours.astype(np.float32)
            m, new = materials.number((id(paint), culled, mesh.colours is not None))
            if new:
                paints.append(_paint(paint, culled, mesh.colours is not None, textures, arrays))
            parts.append([k, m])
        bodies.append({"name": body.name, "picture_only": body.category == "sky", "parts": parts})

    origin = scene.camera_path.pose(int(times_ns[0]))[:3, 3] if len(times_ns) else np.zeros(3)

    def poses(path):
        stack = path.poses(times_ns).copy()
        stack[:, :3, 3] -= origin
        return stack

    arrays["poses"] = np.array([poses(body.path) for body in scene.objects]).reshape(-1, len(times_ns), 4, 4)
    arrays["camera_poses"] = poses(scene.camera_path) @ CV_FROM_BLENDER
    light = scene.light
    if settings.exposure_ns:
        spread = np.linspace(0, settings.exposure_ns, KEYS).astype(np.int64)
        open_ns = (times_ns[:, None] + spread).ravel()
        things = [*(body.path for body in scene.objects), scene.camera_path]
        exposed = np.array([path.poses(open_ns) for path in things])
        exposed[..., :3, 3] -= origin
        exposed[-1] = exposed[-1] @ CV_FROM_BLENDER
        arrays["exposed"] = exposed.reshape(len(things), len(times_ns), KEYS, 4, 4)
    if light.surroundings is not None:
        arrays["panorama"] = seen_around(light)
    lamps = () if light.plain else lamps_of(light)
    arrays["lamp_poses"] = np.array([poses(lamp.path) for lamp in lamps]).reshape(-1, len(times_ns), 4, 4)
    job = {
        "size": [camera.width, camera.height],
        "blender_camera": blender_camera(camera),
        "near": float(camera.near),
        "background": float(scene.background),
        "frames": len(times_ns),
        "settings": {
            key: getattr(settings, key) for key in ("samples", "seed", "shadows", "occlusion", "bounces", "threads")
        },
        "lens": None if settings.lens is None else [settings.lens.aperture, settings.lens.focus],
        "fog": None if scene.fog is None else [scene.fog.density, scene.fog.radiance],
        "light": {
            "sun_direction": [float(s) for s in light.sun_direction],
            "sun": float(light.sun) if light.plain else 0.0,
            "sky": float(light.sky),
            "sky_color": [float(c) for c in light.sky_color],
            "lamps": [
                {
                    "kind": lamp.kind,
                    "strength": [float(s) for s in lamp.strength],
                    "size": float(lamp.size),
                    "outer": float(lamp.outer),
                    "blend": 1.0 - lamp.inner / lamp.outer,
                }
                for lamp in lamps
            ],
        },
        "materials": paints,
        "bodies": bodies,
    }
    np.savez(folder / "job.npz", **arrays)
    (folder / "job.json").write_text(json.dumps(job))


def blender_camera(camera: PinHole) -> dict[str, float | str]:
    """Blender's parameters of the same pin-hole.

    With horizontal fit the sensor's width is W px; a pixel is as wide as the sensor / W, and pixel_aspect_y /
    pixel_aspect_x times as high, so fx = lens W / sensor and fy = fx aspect_x / aspect_y. Shifts are in widths of the
    sensor, +x right, +y up, and move the frame under the optical axis, which with our pixel convention stands at the
    picture's middle for cx = (W - 1) / 2.
    """
    sensor, tall = 36.0, camera.fx / camera.fy
    return {
        "sensor_fit": "HORIZONTAL",
        "sensor_width": sensor,
        "lens": sensor * camera.fx / camera.width,
        "pixel_aspect_x": max(1.0, 1.0 / tall),
        "pixel_aspect_y": max(1.0, tall),  # Blender takes nothing below 1
        "shift_x": ((camera.width - 1) / 2 - camera.cx) / camera.width,
        "shift_y": (camera.cy - (camera.height - 1) / 2) * tall / camera.width,
    }


class _Numbered(dict):
    def number(self, key) -> tuple[int, bool]:
        """(index of key in order of appearance, whether it is new)."""
        new = key not in self
        return self.setdefault(key, len(self)), new


def _paint(material: Material, culled: bool, tinted: bool, textures: _Numbered, arrays: dict) -> dict:
    def stored(key, image: Callable[[], np.ndarray]) -> int:
        index, new = textures.number(key)
        if new:
            arrays[f"texture{index}"] = image()
        return index

    texture, bumps, gloss, mask = material.texture, material.bumps, material.gloss, material.mask
    if material.emission_map is not None or (gloss is not None and gloss.map is not None):
        raise BlinkGLError("the path tracer knows no maps of gloss and emission", where="material")
    return {
        "texture": None if texture is None else stored(id(texture), lambda: linear_image(texture.image)),
        "base_color": [float(c) for c in material.base_color],
        "unlit": material.unlit,
        "culled": culled,
        "tinted": tinted,
        "gloss": None if gloss is None else [gloss.metallic, gloss.roughness],
        "bumps": None if bumps is None else stored(id(bumps), lambda: _numbers(bumps.texture.image)),
        "bump_scale": material.bump_scale,
        "emission": [float(c) for c in material.emission],
        "alpha": None if mask is None else stored(id(mask), lambda: _numbers(np.dstack([mask.alpha] * 3))),
        "threshold": None if mask is None else mask.threshold,
    }


def _numbers(image: np.ndarray) -> np.ndarray:
    return image.astype(np.float32) / np.float32(255)


def _blender_uvs(uvs: np.ndarray, uv_scale: tuple[float, float]) -> np.ndarray:
    """(V, 2) float32. Whole repeats are taken off before the cast, so that a mesh with
    thousands of them has zero in its middle."""
    scaled = uvs.astype(np.float64) * uv_scale
    if len(scaled):
        scaled -= np.rint((scaled.min(axis=0) + scaled.max(axis=0)) / 2)
    # v grows downwards here and upwards in Blender.
    return np.stack([scaled[:, 0], 1.0 - scaled[:, 1]], axis=1).astype(np.float32)


if __name__ == "__main__":
    sys.exit(main())
