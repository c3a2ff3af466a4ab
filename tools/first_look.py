"""A first look at a scene: is the larger error of its events the step's, or the pixel's?

    python -m blinkgl.tools.first_look CONFIG [CONFIG …] [--sequence K] [--set a.b=c]

At three instants of the sequence a frame of it, with the configuration's own filter, is compared with itself drawn four
times finer in both directions: what the *pixel* leaves. And with the mean of two frames half a pixel of motion before
and after it: what a *step* of one pixel leaves. Both are RMS of the logarithm. Closer frames mend the second alone.
docs/trade.md ("No `auto`, and why") has what that foretells in the scenes of the suite, and where it fails.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

from blinkgl.config.sequence import RenderConfig, load_run
from blinkgl.gl import GLContext, create_context
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import sequence_scene
from blinkgl.scene.types import Scene

INSTANTS = (0.25, 0.5, 0.75)
"""Parts of the duration."""
FINER = 4
LEAST = 1e-3
"""Added to luminance before the logarithm."""


class Look(NamedTuple):
    """step, pixel : RMS of the logarithm, see the module; nan where nothing moves."""

    step: float
    pixel: float


def first_look(gl: GLContext, scene: Scene, render: RenderConfig, duration_s: float, px: float = 1.0) -> Look:
    """Of a scene seen by a camera without distortion. px : the step, by the fastest pixel."""
    camera = scene.camera
    finer = scene.with_camera(camera.resized(FINER * camera.width, FINER * camera.height))
    steps, pixels = [], []
    with Renderer(gl, scene, render) as renderer, Renderer(gl, finer, render) as fine:

        def seen(t_ns: float) -> np.ndarray:
            return np.log(renderer.luminance(round(t_ns)).read() + LEAST)

        for part in INSTANTS:
            t_ns = part * duration_s * 1e9
            velocity = renderer.velocity_of_movers(round(t_ns), 2).read()
            speed = float(np.hypot(velocity[..., 0], velocity[..., 1]).max())
            if not speed > 0:
                continue
            half_ns = 0.5e9 * px / speed
            image = fine.luminance(round(t_ns)).read()
            blocks = image.reshape(camera.height, FINER, camera.width, FINER)
            now = seen(t_ns)
            pixels.append(np.mean((now - np.log(blocks.mean(axis=(1, 3)) + LEAST)) ** 2))
            steps.append(np.mean((now - 0.5 * (seen(t_ns - half_ns) + seen(t_ns + half_ns))) ** 2))
    if not steps:
        return Look(np.nan, np.nan)
    return Look(float(np.sqrt(np.mean(steps))), float(np.sqrt(np.mean(pixels))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("configs", nargs="+", metavar="CONFIG")
    parser.add_argument("--sequence", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], metavar="A.B=C")
    options = parser.parse_args()
    with create_context() as gl:
        for path in options.configs:
            template = load_run(path, options.set)
            config = template.sequence(options.sequence)
            if config.frames is not None or config.sensors is not None:
                sys.exit(f"{path}: a first look is at one rendered camera")
            scene = sequence_scene(config, options.sequence, template.base)
            look = first_look(gl, scene, config.render, config.time.duration)
            name, ratio = Path(path).stem, look.step / look.pixel
            print(f"{name:18} step {look.step:.4f}  pixel {look.pixel:.4f}  ratio {ratio:.2f}", flush=True)


if __name__ == "__main__":
    main()
