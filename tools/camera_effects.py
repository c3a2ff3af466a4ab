"""The frame camera's page: one scene, each effect by itself and all together, and what each costs.

    python -m blinkgl.tools.camera_effects [--out docs/images] [--width 400] [--repeat 3] [--json FILE]

Writes ``camera_NAME.jpg`` below OUT, and prints a table for docs/images.md: processor milliseconds per image (of this
process, drawing included, the median of REPEAT), instants, and how far the image is from the mean of 256 instants where
that is asked. Settings take turns, so that a busy machine slows all of them alike.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from blinkgl.config.images import ImagesConfig
from blinkgl.config.sequence import load_run
from blinkgl.gl import create_context
from blinkgl.imaging import CameraImage, FrameCamera
from blinkgl.imaging.response import decode
from blinkgl.machine import bench
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import sequence_scene
from blinkgl.scene.types import Fog

SEQUENCE, AT = 2, 0.8
"""Of flying_objects.yaml, and how far into it."""
BLUR = {"rate": 20, "exposure_us": 40_000.0}
LENS = {"lens": {"aperture": 0.12, "focus": 3.2}}
NOISE = {"photon_noise": True, "read_noise": 4.0, "gain_db": 30.0}
EFFECTS: dict[str, dict[str, Any]] = {
    "instant": {"exposure_us": 1.0},
    "motion_blur": BLUR,
    "rolling_shutter": {"rate": 10, "exposure_us": 1000.0, "row_us": 250.0},
    "defocus": {"exposure_us": 1.0, **LENS},
    "noise": {"exposure_us": 1.0, **NOISE},
    "vignetting": {"exposure_us": 1.0, "vignetting": 1.0},
    "dark": {"exposure_us": 1.0, "white": 4.0},
    "bayer": {"exposure_us": 1.0, "bayer": "rggb"},
    "linear": {"exposure_us": 1.0, "response": "linear"},
    "fog": {"exposure_us": 1.0},
    "everything": {**BLUR, **LENS, **NOISE, "row_us": 50.0, "exposure_us": 30_000.0, "vignetting": 0.6},
}
IN_FOG = ("fog", "everything")
FOG = Fog(0.08, 0.75)
SPACINGS = (2.0, 1.0, 0.5, 0.25, 0.125)


def taken(renderer: Renderer, start_ns: int, **images: Any) -> tuple[CameraImage, float]:
    """One image whose exposure begins at start_ns, and the processor ms that it took."""
    scene = renderer.scene
    config = ImagesConfig(**{**images, "times": (start_ns * 1e-9,)})
    camera = FrameCamera(renderer, config, 1, (scene.t0_ns, scene.t1_ns))
    began = time.process_time()
    image = camera.take()
    return image, 1000 * (time.process_time() - began)


def effects(renderers: dict[bool, Renderer], start_ns: int, out: Path, repeat: int) -> list[dict[str, Any]]:
    """A picture and a row of the table for each effect."""
    costs: dict[str, list[float]] = {name: [] for name in EFFECTS}
    rows = {}
    for turn in range(repeat + 1):  # the first warms up
        for name, images in EFFECTS.items():
            image, ms = taken(renderers[name in IN_FOG], start_ns, **images)
            if turn:
                costs[name].append(ms)
            elif image.image.ndim == 2:
                cv2.imwrite(str(out / f"camera_{name}.jpg"), image.image, [cv2.IMWRITE_JPEG_QUALITY, 90])
            else:
                cv2.imwrite(str(out / f"camera_{name}.jpg"), image.image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
            rows[name] = {"effect": name, "instants": image.instants}
    return [{**row, "ms": float(np.median(costs[name]))} for name, row in rows.items()]


def spacings(renderer: Renderer, start_ns: int) -> list[dict[str, Any]]:
    """Motion blur by ``max_px``, against the mean of 256 instants, linear light in steps of 8 bits."""
    linear = {**BLUR, "bits": 16, "response": "linear", "white": 2.0}
    light = lambda **how: decode(taken(renderer, start_ns, **linear, **how)[0].image, "linear", 2.2, 16)
    truth, rows = light(max_px=1e-3, max_instants=256), []
    for px in SPACINGS:
        image, ms = taken(renderer, start_ns, **linear, max_px=px)
        error = 2.0 * 255 * np.abs(decode(image.image, "linear", 2.2, 16) - truth)  # white is 2
        rows.append(
            {
                "max_px": px,
                "instants": image.instants,
                "ms": ms,
                "median": float(np.median(error)),
                "within_half": float((error <= 0.5).mean()),
                "p999": float(np.percentile(error, 99.9)),
            }
        )
    return rows


def exposure_strip(renderer: Renderer, out: Path) -> None:
    """Automatic exposure: images of a second, which begins much too dark."""
    auto = {"target": 0.25, "lag": 0.12, "longest_us": 15_000.0}
    images = ImagesConfig(rate=12, exposure_us=300.0, white=12.0, auto_exposure=auto)
    scene = renderer.scene
    camera = FrameCamera(renderer, images, 1, (scene.t0_ns, scene.t1_ns))
    strip = []
    for _ in range(8):
        image = camera.take().image[..., ::-1]
        strip.append(
            cv2.resize(image, (image.shape[1] * 2 // 5, image.shape[0] * 2 // 5), interpolation=cv2.INTER_AREA)
        )
    sheet = np.vstack([np.hstack(strip[:4]), np.hstack(strip[4:])])
    cv2.imwrite(str(out / "camera_auto_exposure.jpg"), sheet, [cv2.IMWRITE_JPEG_QUALITY, 85])


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/images"), help="folder of the pictures")
    parser.add_argument("--width", type=int, default=400, help="of the pictures, px")
    parser.add_argument("--repeat", type=int, default=3, help="times that each setting is timed")
    parser.add_argument("--json", type=Path, help="where the figures go, too")
    options = parser.parse_args()
    with resources.as_file(resources.files("blinkgl.configs") / "flying_objects.yaml") as path:
        size = [f"camera.width={options.width}", f"camera.height={options.width * 3 // 4}"]
        template = load_run(path, size)
    config = template.sequence(SEQUENCE)
    with create_context() as gl:
        scene = sequence_scene(config, SEQUENCE, template.base)
        start_ns = int(scene.t0_ns + AT * (scene.t1_ns - scene.t0_ns))
        foggy = replace(scene, fog=FOG)
        with Renderer(gl, scene, config.render) as clear, Renderer(gl, foggy, config.render) as in_fog:
            options.out.mkdir(parents=True, exist_ok=True)
            result = {
                "machine": bench.machine_line(gl.renderer),
                "effects": effects({False: clear, True: in_fog}, start_ns, options.out, options.repeat),
                "spacings": spacings(clear, start_ns),
            }
            exposure_strip(clear, options.out)
    say(result)
    if options.json:
        options.json.write_text(json.dumps(result, indent=1))


def say(result: dict[str, Any]) -> None:
    """The tables, as Markdown."""
    lines = [result["machine"], "", "| effect | instants | processor ms per image |", "|---|---|---|"]
    lines += [
        f"| {row['effect'].replace('_', ' ')} | {row['instants']} | {row['ms']:.0f} |" for row in result["effects"]
    ]
    lines += [
        "",
        "| `max_px` | instants | ms | median error | within half a step | 99.9 % within |",
        "|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {r['max_px']:g} | {r['instants']} | {r['ms']:.0f} | {r['median']:.3f} | {100 * r['within_half']:.1f} % | "
        f"{r['p999']:.2f} |"
        for r in result["spacings"]
    ]
    print("\n".join(lines))


if __name__ == "__main__":
    main()
