"""How fast sequences are made, and where the time goes.

    python -m blinkgl.tools.bench_generate [--quick] [--json FILE] [--peer pyrender]

1. Event pass: frames/s of the luminance pass, clear and read-back included, for three scene sizes and resolutions,
   beside the rate that a throw-away probe of the same scene class reached on this kind of machine (the floor).
2. A whole sequence of each shipped configuration: seconds per simulated second and the split by stage.
3. A still camera: drawing only what moves against drawing all.
4. --peer pyrender: colour + depth of the same world through pyrender (extra [check]), and the ratio.

Everything is the median of many after a warm-up. On a shared machine the minimum is shown as well; ratios taken in one
run are worth more than absolute times.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import tempfile
from dataclasses import replace
from importlib import resources

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from blinkgl.camera import PinHole, focal_length
from blinkgl.config.events import EsimConfig
from blinkgl.config.sequence import RenderConfig, load_run
from blinkgl.dataset.generate import generate_run
from blinkgl.dataset.report import STAGES, Totals
from blinkgl.events.camera import EventCamera, emulate
from blinkgl.gl import create_context
from blinkgl.labels import LabelRequest
from blinkgl.machine import bench
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import build_scene
from blinkgl.scene.geometry import primitives
from blinkgl.scene.motion.paths import SplinePath, StaticPath
from blinkgl.scene.rig import Rig
from blinkgl.scene.surfaces.textures import procedural_texture
from blinkgl.scene.types import Material, Mesh, Part, Scene, SceneObject
from blinkgl.sequence.rendered import drawn

SECOND = 1_000_000_000

# Frames/s of the luminance pass (R32F, clear and read-back included) of the probe that BlinkGL was planned with, on 2
# cores of an AVX-512 Xeon under llvmpipe: one process with two threads, and two processes. None: not measured.
FLOOR = {
    ("full", 640, 480): (86, 114),
    ("tri/16", 640, 480): (278, 359),
    ("tri/16", 346, 260): (533, 860),
    ("tri/16", 1280, 720): (122, 136),
    ("sky + ground", 640, 480): (None, 617),
}
OBJECTS, FULL_SEGMENTS = 10, (100, 56)  # ten spheres of 11,000 triangles: 111k with sky and ground, as the probe's


def probe_scene(kind: str, width: int, height: int, lit: bool = False) -> Scene:
    """Sky box, ground and ten textured objects: "full" (111k triangles), "tri/16" (7k), or "sky + ground" alone."""
    rng = np.random.default_rng(1)
    times = np.linspace(0, 2 * SECOND, 6).astype(np.int64)
    objects = []
    if kind != "sky + ground":
        segments, rings = FULL_SEGMENTS if kind == "full" else (FULL_SEGMENTS[0] // 4, FULL_SEGMENTS[1] // 4)
        for i in range(OBJECTS):
            ball = primitives.sphere(radius=0.9, segments=segments, rings=rings)
            centre = np.array([(i % 4) * 1.9 - 2.9, 5.0 + (i % 3), (i // 4) * 1.7 - 0.6])
            path = SplinePath(times, centre + rng.normal(0, 0.2, (6, 3)), Rotation.random(6, random_state=i))
            material = Material(procedural_texture("fbm", i, 1024), unlit=not lit)
            objects.append(SceneObject(f"ball {i}", i + 1, (Part(ball, material),), path))
    ground = primitives.grid(width=100.0, depth=100.0, subdivisions=8)
    lowered = np.eye(4)
    lowered[2, 3] = -1.5
    material = Material(procedural_texture("bricks", 1, 1024), uv_scale=(25.0, 25.0), unlit=not lit)
    objects.append(SceneObject("ground", 100, (Part(ground, material),), StaticPath(lowered), "ground"))
    box = primitives.cuboid(extents=(100.0, 100.0, 100.0), subdivisions=4)
    inside = Mesh(box.vertices, np.ascontiguousarray(box.faces[:, ::-1]), -box.normals, box.uvs)
    objects.append(
        SceneObject(
            "sky", 101, (Part(inside, Material(procedural_texture("fbm", 77, 1024), unlit=True)),), StaticPath(), "sky"
        )
    )
    level = Rotation.from_matrix(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]))
    keys = np.linspace(0, 2 * SECOND, 4).astype(np.int64)
    turns = Rotation.concatenate([level * Rotation.from_rotvec(rng.normal(0, 0.05, 3)) for _ in keys])
    camera = PinHole.centred(width, height, focal_length(width, math.radians(60)))
    return Scene(tuple(objects), Rig.alone(camera, SplinePath(keys, rng.normal(0, 0.2, (4, 3)), turns)), 0, 2 * SECOND)


PLAIN = RenderConfig(image_antialiasing="none")


def event_pass(gl, kind: str, width: int, height: int, lit: bool, repeat: int) -> dict:
    """Frames/s of Renderer.luminance over moments spread across two seconds."""
    with Renderer(gl, probe_scene(kind, width, height, lit), PLAIN) as renderer:
        moment = iter(range(1 << 30))
        timed = bench.seconds(
            lambda: renderer.luminance(next(moment) * 7_000_000 % (2 * SECOND)).view(), repeat, warm_up=8
        )
        floor = FLOOR.get((kind, width, height), (None, None))
        fps = 1 / timed["median"]
        return {
            "scene": kind,
            "lit": lit,
            "width": width,
            "height": height,
            "triangles": renderer.triangles,
            "fps": fps,
            "fps_best": 1 / timed["min"],
            "floor_one_process": floor[0],
            "floor_two_processes": floor[1],
            "ratio_one_process": fps / floor[0] if floor[0] else None,
            "ratio_two_processes": fps / floor[1] if floor[1] else None,
        }


def still_camera(gl, kind: str, movers: int, repeat: int) -> dict:
    """Full redraw against redrawing only what moves: luminance and ESIM together, the same events."""
    scene = probe_scene(kind, 640, 480)
    objects = tuple(
        o if i < movers else replace(o, path=StaticPath(o.path.pose(0))) for i, o in enumerate(scene.objects)
    )
    scene = replace(scene, objects=objects).with_path(StaticPath(scene.camera_path.pose(0)))
    result = {"scene": kind, "movers": movers}
    events = {}
    for name in ("full redraw", "what moves"):
        with Renderer(gl, scene, PLAIN, whole=name == "full redraw") as renderer:
            event_pass = emulate(
                drawn(renderer, itertools.count(0, 2_000_000)), EventCamera(EsimConfig(), None, 480, 640, seed=1)
            )
            made = events[name] = []
            frame = lambda run=event_pass, made=made: made.append(len(next(run)[1]))
            result[name] = 1 / bench.seconds(frame, repeat, warm_up=8)["median"]
    assert events["full redraw"] == events["what moves"]
    result["ratio"] = result["what moves"] / result["full redraw"]
    return result


def sequence(name: str, quick: bool) -> dict:
    """One sequence of a shipped configuration; the first, unmeasured one compiles kernels and shaders."""
    overrides = ["time.duration=0.2"] if quick else []
    path = resources.files("blinkgl.configs") / name
    with tempfile.TemporaryDirectory() as folder:
        list(generate_run(load_run(path, ["time.duration=0.1"]), f"{folder}/warm", 1))
        report = list(generate_run(load_run(path, overrides), f"{folder}/timed", 1))[0]
    return {"config": name, "triangles": report.triangles, **Totals().add(report).summary()}


def peer(gl, quick: bool) -> dict:
    """The flying_objects world, colour + depth, here and through pyrender."""
    from blinkgl.tools import peer_pyrender

    if missing := peer_pyrender.available():
        return {"unavailable": missing}
    config = load_run(resources.files("blinkgl.configs") / "flying_objects.yaml").sequence(0)
    scene = build_scene(config.scene, config.camera, config.time.t0_ns, config.time.t1_ns, seed=config.seed)
    times = np.linspace(scene.t0_ns, scene.t1_ns, 5 if quick else 20).astype(np.int64)
    theirs = peer_pyrender.measure(scene, times)
    with Renderer(gl, scene, PLAIN) as renderer:
        moments = iter(list(map(int, times)) * 100)

        def both():
            t = next(moments)
            renderer.labels(t, LabelRequest("images", "depth"))

        ours = bench.seconds(both, 10 if quick else 40)["median"]
        luminance = bench.seconds(lambda: renderer.luminance(next(moments)).read(), 10 if quick else 40)["median"]
    return {
        "pyrender_s_per_frame": theirs["seconds_per_frame"],
        "blinkgl_colour_depth_s_per_frame": ours,
        "blinkgl_luminance_s_per_frame": luminance,
        "ratio_colour_depth": theirs["seconds_per_frame"] / ours,
        "ratio_luminance": theirs["seconds_per_frame"] / luminance,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer repeats and shorter sequences")
    parser.add_argument("--json", metavar="FILE", help="write the results there as well")
    parser.add_argument("--peer", choices=["pyrender"], help="also time this independent renderer")
    options = parser.parse_args()
    console, repeat = Console(), 20 if options.quick else 100
    result: dict = {}
    with create_context() as gl:
        result["machine"] = bench.machine_line(gl.renderer)
        console.print(result["machine"], highlight=False, soft_wrap=True)
        cases = [
            ("full", 640, 480),
            ("tri/16", 640, 480),
            ("sky + ground", 640, 480),
            ("tri/16", 346, 260),
            ("tri/16", 1280, 720),
        ]
        result["event_pass"] = [event_pass(gl, *case, lit=False, repeat=repeat) for case in cases]
        result["event_pass"] += [event_pass(gl, *case, lit=True, repeat=repeat) for case in cases[:2]]
        _show_event_pass(console, result["event_pass"])
        result["still_camera"] = [
            still_camera(gl, kind, movers, repeat) for kind in ("tri/16", "full") for movers in (1, 3)
        ]
        for r in result["still_camera"]:
            console.print(
                f"still camera, {r['scene']}, {r['movers']} of 10 objects moving: {r['full redraw']:.0f} frames/s "
                f"drawn whole, {r['what moves']:.0f} where something moves: {r['ratio']:.1f}x (luminance and ESIM, "
                "same events)",
                highlight=False,
                soft_wrap=True,
            )
        if options.peer:
            result["peer"] = peer(gl, options.quick)
            console.print("pyrender:", result["peer"])
    result["sequences"] = [sequence(name, options.quick) for name in ("demo.yaml", "flying_objects.yaml")]
    _show_sequences(console, result["sequences"])
    if options.json:
        with open(options.json, "w", encoding="utf-8") as file:
            json.dump(result, file, indent=1)


def _show_event_pass(console: Console, rows: list[dict]) -> None:
    table = Table(title="event pass (luminance, read back)", title_justify="left")
    for column in (
        "scene",
        "light",
        "size",
        "triangles",
        "frames/s",
        "best",
        "of floor, 1 process",
        "of floor, 2 processes",
    ):
        table.add_column(column, justify="left" if column in ("scene", "light", "size") else "right")
    ratio = lambda value, floor: f"{value:.2f} of {floor}" if floor else "–"
    for r in rows:
        table.add_row(
            r["scene"],
            "sun + sky" if r["lit"] else "unlit",
            f"{r['width']}x{r['height']}",
            f"{r['triangles']:,}",
            f"{r['fps']:.0f}",
            f"{r['fps_best']:.0f}",
            ratio(r["ratio_one_process"], r["floor_one_process"]),
            ratio(r["ratio_two_processes"], r["floor_two_processes"]),
        )
    console.print(table)


def _show_sequences(console: Console, rows: list[dict]) -> None:
    table = Table(title="whole sequences", title_justify="left")
    table.add_column("")
    for r in rows:
        table.add_column(r["config"], justify="right")
    table.add_row("seconds per simulated second", *(f"{r['seconds_per_simulated_second']:.2f}" for r in rows))
    table.add_row("event frames", *(f"{r['frames']}" for r in rows))
    table.add_row("events", *(f"{r['events'] / 1e6:.1f} M" for r in rows))
    table.add_row("M events/s", *(f"{r['events_per_second'] / 1e6:.2f}" for r in rows))
    for stage in (*STAGES, "other"):
        table.add_row(stage, *(f"{r[f'{stage}_s']:.2f} s {100 * r[f'{stage}_s'] / r['total_s']:4.0f} %" for r in rows))
    console.print(table)


if __name__ == "__main__":
    main()
