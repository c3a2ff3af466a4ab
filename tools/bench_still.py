"""A still camera with one moving object: redrawing only what moves against redrawing everything, drawing to events.

    python -m blinkgl.tools.bench_still [--coverage 0.05] [--rounds 200] [--quality balanced] [--json FILE]

bench_generate's probe scene (10 balls, ground and sky; "tri/16": 7,000 triangles, "full": 110,000), 640x480, camera and
nine balls at rest, the tenth at a distance at which its rectangle covers about ``--coverage`` of the image, moving by
half a pixel per frame. Both ways take turns of ten frames, each with its own renderer and ESIM emulator; times are
medians, "mean" is over all frames. The events are compared one by one.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from blinkgl.config.events import EsimConfig
from blinkgl.config.quality import QUALITIES, load_quality
from blinkgl.config.sequence import RenderConfig
from blinkgl.events import Events
from blinkgl.events.camera import EventCamera, EventFrame
from blinkgl.gl import create_context
from blinkgl.machine import bench
from blinkgl.render.renderer import Renderer
from blinkgl.scene.motion.paths import KeyframePath, StaticPath
from blinkgl.scene.types import Scene
from blinkgl.tools.bench_generate import PLAIN, SECOND, probe_scene

WIDTH, HEIGHT = 640, 480
STEP_NS = 2_000_000
PX_PER_FRAME = 0.5
TURN = 10
"""Frames that one way draws before it is the other's turn: a way runs with its own data in
the caches, as it would alone."""


def one_mover(kind: str, coverage: float) -> Scene:
    """The probe scene at rest, but for a ball that crosses the image in front of the others."""
    scene = probe_scene(kind, WIDTH, HEIGHT)
    at = scene.camera_path.pose(0)
    focal = scene.camera.jacobian(np.array([0.0, 0.0, 1.0]))[0, 0]  # px per unit and unit of depth
    mover = scene.objects[0]
    radius = float(np.linalg.norm(mover.parts[0].mesh.vertices, axis=1).max())
    distance = 2 * radius * focal / np.sqrt(coverage * WIDTH * HEIGHT)
    speed = PX_PER_FRAME / (STEP_NS * 1e-9) * distance / focal  # units per second, across the image
    seen = lambda s: at[:3, :3] @ [s, 0.1 * s, distance] + at[:3, 3]
    path = KeyframePath(
        [0, 2 * SECOND],
        [seen(-speed / 4), seen(speed * 7 / 4)],
        [Rotation.identity().as_quat()] * 2,
        interpolation="linear",
    )
    objects = tuple(
        replace(o, path=path if i == 0 else StaticPath(o.path.pose(0))) for i, o in enumerate(scene.objects)
    )
    return replace(scene, objects=objects).with_path(StaticPath(at))


class Way:
    """One way of drawing, from the scene to events; seconds of each stage and frame."""

    def __init__(self, gl, scene: Scene, still: bool, render: RenderConfig = PLAIN):
        self.renderer = Renderer(gl, scene, render, whole=not still)
        self.camera = EventCamera(EsimConfig(), None, HEIGHT, WIDTH, seed=1)
        self.frame = None
        self.events: list[Events] = []
        self.stages: list[tuple[float, ...]] = []
        self.covered: list[float] = []

    def step(self, t_ns: int) -> None:
        stats = self.renderer.stats
        drawn, read = stats.render_s, stats.readback_s
        wall, cpu = time.perf_counter(), time.process_time()
        before, self.frame = self.frame, self.renderer.luminance(t_ns)
        luminance = self.frame.read()
        done = time.perf_counter()
        self.events.append(self.camera.step(EventFrame(t_ns, luminance, rows=self.frame.rows_changed_since(before))))
        end = time.perf_counter()
        self.stages.append(
            (stats.render_s - drawn, stats.readback_s - read, end - done, end - wall, time.process_time() - cpu)
        )
        if self.frame.changed is not None:
            self.covered.append(sum(r.area for r in self.frame.changed) / (WIDTH * HEIGHT))


STAGES = ("draw", "read-back", "kernel", "all", "cpu")


def measure(gl, kind: str, coverage: float, rounds: int, warm_up: int = 10, render: RenderConfig = PLAIN) -> dict:
    scene = one_mover(kind, coverage)
    ways = {"full redraw": Way(gl, scene, False, render), "what moves": Way(gl, scene, True, render)}
    for start in range(0, rounds + warm_up, TURN):
        for way in ways.values():
            for k in range(start, start + TURN):
                way.step(k * STEP_NS)
    full, quick = (Events.concatenate(w.events) for w in ways.values())
    assert all(np.array_equal(getattr(full, name), getattr(quick, name)) for name in ("x", "y", "t", "p"))
    result = {
        "scene": kind,
        "triangles": ways["full redraw"].renderer.triangles,
        "events": len(full),
        "covered": float(np.mean(ways["what moves"].covered[warm_up:])),
    }
    for name, way in ways.items():
        stages = np.array(way.stages[warm_up:]) * 1e3
        result[name] = {s: float(v) for s, v in zip(STAGES, np.median(stages, axis=0))} | {
            "mean": float(stages[:, 3].mean())
        }
        way.renderer.release()
    result["ratio"] = {s: result["full redraw"][s] / result["what moves"][s] for s in (*STAGES, "mean")}
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--coverage",
        type=float,
        default=0.035,
        help="of the image, by the ball alone; what is redrawn is a little more",
    )
    parser.add_argument("--rounds", type=int, default=200)
    parser.add_argument("--quality", choices=QUALITIES, help="draw as this preset does, in the place of no filter")
    parser.add_argument("--json")
    arguments = parser.parse_args()
    render = PLAIN
    if arguments.quality is not None:
        render = PLAIN.model_copy(update=load_quality(arguments.quality)["render"])
    with create_context() as gl:
        report = {
            "machine": bench.machine_line(gl.renderer),
            "results": [
                measure(gl, kind, arguments.coverage, arguments.rounds, render=render) for kind in ("tri/16", "full")
            ],
        }
    table = Table(title=report["machine"], title_justify="left")
    for column in ("scene", "way", *(f"{s} ms" for s in (*STAGES, "mean"))):
        table.add_column(column, justify="left" if column in ("scene", "way") else "right")
    for r in report["results"]:
        title = (
            f"{r['scene']} ({r['triangles']:,} triangles; {100 * r['covered']:.1f} % redrawn; {r['events']:,} events)"
        )
        for name in ("full redraw", "what moves"):
            table.add_row(title, name, *(f"{r[name][s]:.3f}" for s in (*STAGES, "mean")))
            title = ""
        table.add_row("", "ratio", *(f"{r['ratio'][s]:.1f}x" for s in (*STAGES, "mean")))
    Console(width=170).print(table)
    if arguments.json:
        with open(arguments.json, "w", encoding="utf-8") as file:
            json.dump(report, file, indent=1)


if __name__ == "__main__":
    main()
