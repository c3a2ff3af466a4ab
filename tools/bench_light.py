"""What light costs: processor time of an event frame with each effect, in turns, as ratios to the plain sun and sky.

    python -m blinkgl.tools.bench_light [CONFIG] [--frames 24] [--rounds 5] [--set a.b=c …] [--json FILE]

Every round draws the same frames with every light, one light after the other, so that a machine's moods are
everybody's; the figure is the median over the rounds. Labels and colour are not drawn.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from importlib import resources

import numpy as np
from rich.console import Console
from rich.table import Table

from blinkgl.config.sequence import load_run
from blinkgl.errors import BlinkGLError
from blinkgl.gl import create_context
from blinkgl.machine import bench
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import sequence_scene
from blinkgl.scene.lights import lamp_pose
from blinkgl.scene.motion.paths import StaticPath
from blinkgl.scene.types import Lamp, Light, Scene


def lights(plain: Light) -> dict[str, Light]:
    """By name; the first is what the others are compared with."""
    up = [[0.0, 0.0, 0.0, 0.0], [0.0, 0.02, 0.0, 0.01], [0.0, 0.0, 0.05, 0.1], [0.0, 0.01, 0.1, 0.4]]

    def around(r: float, g: float, b: float):
        return tuple(tuple(tuple(c * v for v in row) for row in up) for c in (r, g, b))

    sun = {"sun": plain.sun, "sun_direction": plain.sun_direction}
    point = Lamp("point", (3.0, 3.0, 3.0), StaticPath(lamp_pose((2.0, 1.0, 3.0))))
    spot = Lamp("spot", (9.0, 9.0, 9.0), StaticPath(lamp_pose((-2.0, 1.0, 4.0), (0.2, 0.0, -1.0))))
    return {
        "plain": plain,
        "environment, white": Light(**sun, sky=0.0, around=around(1, 1, 1)),
        "environment, coloured": Light(**sun, sky=0.0, around=around(0.8, 0.9, 1.2)),
        "point and spot, white": replace(plain, lamps=(point, spot)),
        "hard shadows": replace(plain, shadows="hard"),
        "hard shadows, map of 2048": replace(plain, shadows="hard", shadow_size=2048),
        "soft shadows": replace(plain, shadows="soft"),
    }


def measure(gl, scene: Scene, config, frames: int, rounds: int) -> dict[str, dict[str, float]]:
    """By light: ms of processor time per frame, and times the plain light's, medians over the rounds."""
    times = np.linspace(scene.t0_ns, scene.t1_ns, frames + 2).astype(np.int64)[1:-1].tolist()
    renderers = {name: Renderer(gl, replace(scene, light=light), config) for name, light in lights(scene.light).items()}
    spent: dict[str, list[float]] = {name: [] for name in renderers}
    for renderer in renderers.values():
        renderer.luminance(times[-1]).read()  # compiles and uploads
    for _ in range(rounds):
        for name, renderer in renderers.items():
            started = time.process_time()
            for t in times:
                renderer.luminance(t).view()
            spent[name].append((time.process_time() - started) / frames * 1e3)
    for renderer in renderers.values():
        renderer.release()
    base = np.array(next(iter(spent.values())))
    return {
        name: {"ms": float(np.median(ms)), "ratio": float(np.median(np.array(ms) / base))} for name, ms in spent.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", nargs="?", default=str(resources.files("blinkgl.configs") / "flying_objects.yaml"))
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="a.b=c")
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", metavar="FILE")
    options = parser.parse_args()
    template = load_run(options.config, options.overrides)
    config = template.sequence(0)
    scene = sequence_scene(config, 0, template.base)
    console = Console()
    with create_context() as gl:
        console.print(bench.machine_line(gl.renderer), highlight=False, soft_wrap=True)
        found = measure(gl, scene, config.render, options.frames, options.rounds)
    table = Table(title=f"{scene.camera.width}x{scene.camera.height}, event frames", title_justify="left")
    for name in ("light", "processor ms per frame", "times the plain one"):
        table.add_column(name, justify="left" if name == "light" else "right")
    for name, row in found.items():
        table.add_row(name, f"{row['ms']:.2f}", f"{row['ratio']:.3f}")
    console.print(table)
    if options.json:
        with open(options.json, "w") as file:
            json.dump(found, file, indent=1)


if __name__ == "__main__":
    try:
        main()
    except BlinkGLError as error:
        raise SystemExit(f"error: {error}") from None
