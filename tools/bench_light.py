"""What light and materials cost: processor time of an event frame with each effect, in turns, as ratios to the plain
sun and sky, and to matt surfaces.

    python -m blinkgl.tools.bench_light [CONFIG] [--materials] [--only NAME …] [--frames 24] [--rounds 5]
                                        [--set a.b=c …] [--json FILE] [--changes]

Every round draws the same frames with every light, one light after the other, so that a machine's moods are
everybody's; the figure is the median over the rounds. Labels and colour are not drawn.

--changes: what each changes instead, beside the first row: events of ESIM (threshold 0.2, no noise) that are missed and
extra, as shares of the first row's, partners at most 5 ms apart; the mean difference of pictures, of their mean; the
share of pixels whose labels differ.
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

from blinkgl.config.events import EsimConfig
from blinkgl.config.sequence import load_run
from blinkgl.errors import BlinkGLError
from blinkgl.events import Esim, Events
from blinkgl.gl import create_context
from blinkgl.labels import LabelRequest
from blinkgl.machine import bench
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import sequence_scene
from blinkgl.scene.lights import lamp_pose
from blinkgl.scene.motion.paths import StaticPath
from blinkgl.scene.types import Gloss, Lamp, Light, Map, Mask, Part, Scene, SceneObject, Texture
from blinkgl.trade.matching import match_events


def lights(plain: Light) -> dict[str, Light]:
    """By name; the first is what the others are compared with."""
    up = [[0.0, 0.0, 0.0, 0.0], [0.0, 0.02, 0.0, 0.01], [0.0, 0.0, 0.05, 0.1], [0.0, 0.01, 0.1, 0.4]]

    def around(r: float, g: float, b: float):
        return tuple(tuple(tuple(c * v for v in row) for row in up) for c in (r, g, b))

    finer = tuple(tuple(map(tuple, one)) for one in (0.02 * np.ones((3, 9, 9))).tolist())
    sun = {"sun": plain.sun, "sun_direction": plain.sun_direction}
    point = Lamp("point", (3.0, 3.0, 3.0), StaticPath(lamp_pose((2.0, 1.0, 3.0))))
    spot = Lamp("spot", (9.0, 9.0, 9.0), StaticPath(lamp_pose((-2.0, 1.0, 4.0), (0.2, 0.0, -1.0))))
    return {
        "plain": plain,
        "environment, white": Light(**sun, sky=0.0, around=around(1, 1, 1)),
        "environment, coloured": Light(**sun, sky=0.0, around=around(0.8, 0.9, 1.2)),
        "order 4, white": Light(**sun, sky=0.0, around=around(1, 1, 1), finer=finer),
        "order 4, coloured": Light(**sun, sky=0.0, around=around(0.8, 0.9, 1.2), finer=finer),
        "point and spot, white": replace(plain, lamps=(point, spot)),
        "hard shadows": replace(plain, shadows="hard"),
        "hard shadows, map of 2048": replace(plain, shadows="hard", shadow_size=2048),
        "soft shadows": replace(plain, shadows="soft"),
        "coloured sun and sky": replace(plain, sun_color=(1.0, 0.9, 0.7), sky_color=(0.6, 0.8, 1.0)),
    }


def dressed(scene: Scene) -> dict[str, Scene]:
    """By what all its objects are made of; the first is as it is."""
    bumps = Map(Texture(np.random.default_rng(0).integers(96, 160, (256, 256, 3)).astype(np.uint8)))
    opacity = np.kron(np.indices((16, 16)).sum(axis=0) % 4 > 0, np.ones((16, 16))).astype(np.uint8) * 255
    materials = {
        "plain": {},
        "gloss": {"gloss": Gloss(0.0, 0.4)},
        "metal": {"gloss": Gloss(1.0, 0.4)},
        "normal map": {"bumps": bumps},
        "gloss and normal map": {"gloss": Gloss(0.0, 0.4), "bumps": bumps},
        "light of its own": {"emission": (0.1, 0.1, 0.1)},
        "holes": {"mask": Mask(opacity)},
    }

    def of(thing: SceneObject, more: dict) -> SceneObject:
        if thing.category == "sky":
            return thing
        return replace(thing, parts=tuple(Part(p.mesh, replace(p.material, **more)) for p in thing.parts))

    return {
        name: replace(scene, objects=tuple(of(thing, more) for thing in scene.objects))
        for name, more in materials.items()
    }


def measure(gl, scenes: dict[str, Scene], config, frames: int, rounds: int) -> dict[str, dict[str, float]]:
    """By name: ms of processor time per frame, and times the first one's, medians over the rounds."""
    scene = next(iter(scenes.values()))
    times = np.linspace(scene.t0_ns, scene.t1_ns, frames + 2).astype(np.int64)[1:-1].tolist()
    renderers = {name: Renderer(gl, one, config) for name, one in scenes.items()}
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


def changes(gl, scenes: dict[str, Scene], config, frames: int) -> dict[str, dict[str, float]]:
    """By name: shares of events missed and extra, of luminance and of labels that each changes of the first one's."""
    found: dict[str, dict[str, float]] = {}
    first = None
    for name, scene in scenes.items():
        times = np.linspace(scene.t0_ns, scene.t1_ns, frames).astype(np.int64).tolist()
        height, width = scene.camera.height, scene.camera.width
        emulator = Esim(height, width, EsimConfig(contrast_threshold=0.2, threshold_sigma=0.0), 0)
        with Renderer(gl, scene, config) as renderer:
            parts = [emulator.step(renderer.luminance(t).read(), t) for t in times]
            pictures = np.stack([renderer.luminance(t).read() for t in times[:: max(1, frames // 8)]])
            asked = LabelRequest("ids", "flow_forward")
            labels = renderer.labels(times[0], asked, times[min(10, frames - 1)])
        events = Events.concatenate(parts)
        if first is None:
            first = events, pictures, labels
        before, seen, known = first
        matching = match_events(before, events, height, width, 5000)
        differ = (labels.ids != known.ids) | (
            np.abs(labels.flow_forward.flow - known.flow_forward.flow).max(axis=-1) > 1e-3
        )
        found[name] = {
            "missed": float((~matching.matched).mean()),
            "extra": matching.extra / len(before),
            "pictures": float(np.abs(pictures - seen).mean() / seen.mean()),
            "labels": float(differ.mean()),
        }
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", nargs="?", default=str(resources.files("blinkgl.configs") / "flying_objects.yaml"))
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="a.b=c")
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--materials", action="store_true", help="of materials instead: all objects wear each")
    parser.add_argument("--only", action="append", default=[], metavar="NAME", help="these rows, beside the first")
    parser.add_argument("--changes", action="store_true", help="what each changes instead of what it costs")
    parser.add_argument("--json", metavar="FILE")
    options = parser.parse_args()
    template = load_run(options.config, options.overrides)
    config = template.sequence(0)
    scene = sequence_scene(config, 0, template.base)
    console = Console()
    with create_context() as gl:
        console.print(bench.machine_line(gl.renderer), highlight=False, soft_wrap=True)
        of_lights = {name: replace(scene, light=light) for name, light in lights(scene.light).items()}
        scenes = dressed(scene) if options.materials else of_lights
        if options.only:
            scenes = {name: one for k, (name, one) in enumerate(scenes.items()) if k == 0 or name in options.only}
        if options.changes:
            found = changes(gl, scenes, config.render, options.frames)
        else:
            found = measure(gl, scenes, config.render, options.frames, options.rounds)
    if options.changes:
        table = Table(title=f"{scene.camera.width}x{scene.camera.height}, what changes, %", title_justify="left")
        for name in ("light", "events missed", "events extra", "pictures", "labels"):
            table.add_column(name, justify="left" if name == "light" else "right")
        for name, row in found.items():
            table.add_row(name, *(f"{100 * value:.1f}" for value in row.values()))
        console.print(table)
        return
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
