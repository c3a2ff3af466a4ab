"""How well each kind of spatial filtering makes events, and what it costs.

    python -m blinkgl.tools.bench_filtering [CONFIG] [--sequences 0 1] [--frames 120] [--json FILE]

The same scenes at the same times with every setting; events (ESIM) and luminance are judged by frames drawn SS x SS
times finer with a camera of its own and averaged by NumPy. All settings take turns frame by frame, so that a busy
machine slows all of them alike; processor seconds are printed beside wall time. Wrong: events without a partner within
the pixel, the polarity and ``--limit`` ms, missed and extra together, over the reference's count.
"""

from __future__ import annotations

import argparse
import json
import time
from importlib import resources
from itertools import islice

import numpy as np
from rich.console import Console
from rich.table import Table

from blinkgl.config.events import EsimConfig
from blinkgl.config.sequence import RenderConfig, load_run
from blinkgl.events import Events
from blinkgl.events.camera import EventCamera, EventFrame
from blinkgl.gl import create_context
from blinkgl.machine import bench
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import sequence_scene
from blinkgl.scene.types import Scene
from blinkgl.timeline import displacement_times
from blinkgl.timeline.speed import largest_speed
from blinkgl.trade.matching import match_events

PLAIN = RenderConfig(image_antialiasing="none")
SETTINGS = {
    name: RenderConfig(image_antialiasing="none", **changes)
    for name, changes in {
        "none, mip -1": {"mip_bias": -1.0},
        "none, mip -0.5": {"mip_bias": -0.5},
        "none": {},
        "none, aniso 4": {"anisotropy": 4.0},
        "msaa4": {"antialiasing": "msaa4"},
        "msaa4, mip -0.5": {"antialiasing": "msaa4", "mip_bias": -0.5},
        "taps4": {"antialiasing": "taps4"},
        "taps4, mip -0.5": {"antialiasing": "taps4", "mip_bias": -0.5},
        "taps4, mip -1": {"antialiasing": "taps4", "mip_bias": -1.0},
        "ssaa2": {"antialiasing": "ssaa2"},
        "ssaa2, mip -0.5": {"antialiasing": "ssaa2", "mip_bias": -0.5},
        "ssaa2, mip -1": {"antialiasing": "ssaa2", "mip_bias": -1.0},
        "ssaa4": {"antialiasing": "ssaa4"},
        "ssaa4, mip -0.5": {"antialiasing": "ssaa4", "mip_bias": -0.5},
    }.items()
}


def finer(scene: Scene, factor: int) -> Scene:
    """The same view with factor x factor samples per pixel."""
    return scene.with_camera(scene.camera.resized(scene.camera.width * factor, scene.camera.height * factor))


class Judged:
    """One setting on one scene: its renderer, its emulator, its events and its costs."""

    def __init__(self, gl, scene: Scene, config, emulator, factor: int = 1):
        self.factor, self.renderer = factor, Renderer(gl, finer(scene, factor) if factor > 1 else scene, config)
        camera = scene.camera
        self.camera = EventCamera(emulator, None, camera.height, camera.width, 0)
        self.frame = np.empty((camera.height * factor, camera.width * factor), np.float32)
        self.shape = (camera.height, camera.width)
        self.parts: list[Events] = []
        self.wall: list[float] = []
        self.cpu: list[float] = []

    def step(self, t_ns: int) -> np.ndarray:
        wall, cpu = time.perf_counter(), time.process_time()
        image = self.renderer.luminance(t_ns).read(out=self.frame)
        self.wall.append(time.perf_counter() - wall)
        self.cpu.append(time.process_time() - cpu)
        if self.factor > 1:
            image = image.reshape(self.shape[0], self.factor, self.shape[1], self.factor).mean(axis=(1, 3))
        self.parts.append(self.camera.step(EventFrame(t_ns, image)))
        return image

    @property
    def events(self) -> Events:
        return Events.concatenate(self.parts)


def judge(gl, scene: Scene, settings: dict, times: list[int], factor: int, limit_us: int, emulator) -> dict[str, dict]:
    """setting -> events, missed, extra (shares of the reference's), log_rmse, and ms and
    processor ms per frame (medians)."""
    reference = Judged(gl, scene, PLAIN, emulator, factor)
    judged = {name: Judged(gl, scene, config, emulator) for name, config in settings.items()}
    squares = dict.fromkeys(settings, 0.0)
    names = list(settings)
    for k, t_ns in enumerate(times):
        true = np.log(reference.step(t_ns) + 1e-3)
        for name in names[k % len(names) :] + names[: k % len(names)]:
            squares[name] += float(np.mean((np.log(judged[name].step(t_ns) + 1e-3) - true) ** 2))
    height, width = scene.camera.height, scene.camera.width
    true, out = reference.events, {}
    for name, one in judged.items():
        events = one.events
        matching = match_events(true, events, height, width, limit_us)
        late = np.abs(matching.dt_us[matching.matched])
        out[name] = {
            "events": len(events) / len(true),
            "missed": float((~matching.matched).mean()),
            "extra": matching.extra / len(true),
            "time_median_us": float(np.median(late)),
            "log_rmse": float(np.sqrt(squares[name] / len(times))),
            "ms": 1e3 * float(np.median(one.wall)),
            "cpu_ms": 1e3 * float(np.median(one.cpu)),
        }
        one.renderer.release()
    reference.renderer.release()
    return {"reference_events": len(true), "settings": out}


def displacement_frames(gl, scene: Scene, max_px: float, count: int) -> list[int]:
    """The first ``count`` times, ns, between which nothing moves further than ``max_px``."""
    with Renderer(gl, scene, PLAIN) as renderer:
        return list(
            islice(
                displacement_times(
                    max_px,
                    200_000,
                    20_000_000,
                    scene.t0_ns,
                    scene.t1_ns,
                    lambda t: largest_speed(renderer.velocity_of_movers(t, 4).read()),
                ),
                count,
            )
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("config", nargs="?", default=str(resources.files("blinkgl.configs") / "flying_objects.yaml"))
    parser.add_argument(
        "--set", action="append", default=["camera.width=346", "camera.height=260"], metavar="KEY=VALUE"
    )
    parser.add_argument("--sequences", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--factor", type=int, default=8, help="the reference's samples per pixel along x and y")
    parser.add_argument("--max-px", type=float, default=0.5, help="displacement between frames, px")
    parser.add_argument("--limit", type=float, default=10.0, help="partners are at most this far apart, ms")
    parser.add_argument("--json")
    arguments = parser.parse_args()
    run = load_run(arguments.config, arguments.set)
    report = {
        "frames": arguments.frames,
        "factor": arguments.factor,
        "max_px": arguments.max_px,
        "limit_ms": arguments.limit,
        "sequences": {},
    }
    with create_context() as gl:
        report["machine"] = bench.machine_line(gl.renderer)
        for index in arguments.sequences:
            config = run.sequence(index)
            scene = sequence_scene(config, index, run.base)
            times = displacement_frames(gl, scene, arguments.max_px, arguments.frames)
            report["sequences"][index] = judge(
                gl,
                scene,
                SETTINGS,
                times,
                arguments.factor,
                int(arguments.limit * 1e3),
                EsimConfig(contrast_threshold=0.2),
            )
    results = [s["settings"] for s in report["sequences"].values()]
    report["mean"] = {
        name: {key: float(np.mean([r[name][key] for r in results])) for key in results[0][name]} for name in SETTINGS
    }
    print_table(report)
    if arguments.json:
        with open(arguments.json, "w", encoding="utf-8") as file:
            json.dump(report, file, indent=1)


def print_table(report: dict) -> None:
    table = Table(
        title=f"against {report['factor']}x{report['factor']} samples; {report['machine']}", title_justify="left"
    )
    for column in ("setting", "events", "missed", "extra", "wrong", "log RMSE", "ms", "times none", "cpu times none"):
        table.add_column(column, justify="left" if column == "setting" else "right")
    plain = report["mean"]["none"]
    for name, r in report["mean"].items():
        table.add_row(
            name,
            f"{r['events']:.3f}",
            f"{r['missed']:.3f}",
            f"{r['extra']:.3f}",
            f"{r['missed'] + r['extra']:.3f}",
            f"{r['log_rmse']:.3f}",
            f"{r['ms']:.2f}",
            f"{r['ms'] / plain['ms']:.2f}",
            f"{r['cpu_ms'] / plain['cpu_ms']:.2f}",
        )
    Console(width=160).print(table)


if __name__ == "__main__":
    main()
