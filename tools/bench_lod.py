"""What level of detail saves and what it costs, on a random scene of about 100,000 triangles.

    python -m blinkgl.tools.bench_lod [--edge 2 4 8] [--error 0.25] [--antialiasing none ssaa2] [--json FILE]

The scene is ``kind: random`` with a pool of finely meshed files made here (bumpy stones, knots, uv spheres: smooth,
textured, with seams). Variants: without back-face and frustum culling, as it is by default, and with levels of detail;
all of them take turns frame by frame, so that a busy machine slows them alike, and processor seconds are printed beside
wall time. Events (ESIM) are judged against the full meshes drawn 8 x 8 times finer, as in bench_filtering.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
import trimesh
from rich.console import Console
from rich.table import Table

from blinkgl.config.events import EsimConfig
from blinkgl.config.lod import LodConfig
from blinkgl.config.sequence import RenderConfig, RunTemplate
from blinkgl.events.camera import EventCamera, EventFrame
from blinkgl.gl import create_context
from blinkgl.machine import bench
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import build_scene
from blinkgl.scene.types import Scene
from blinkgl.tools.bench_filtering import displacement_frames, judge

MESHES = 12


def fine_meshes(folder: Path) -> None:
    """Files of 5,000 to 20,000 triangles."""
    ball = trimesh.creation.icosphere(subdivisions=5)
    for i in range(MESHES):
        rng = np.random.default_rng(i)
        if i % 3 == 0:  # a stone: no texture coordinates, so they are projected from six sides
            points = ball.vertices * rng.uniform(0.6, 1.0, 3)
            for octave in range(3):
                phase = ball.vertices @ rng.normal(size=(3, 4)) * 2.5 * 2**octave + rng.uniform(0, 2 * np.pi, 4)
                points = points * (1 + 0.06 / 2**octave * np.sin(phase).mean(axis=1, keepdims=True))
            trimesh.Trimesh(points, ball.faces, process=False).export(folder / f"stone{i}.ply")
        elif i % 3 == 1:  # a knot's tube: texture coordinates along and around it
            (folder / f"knot{i}.obj").write_text(_surface(*_knot(rng)))
        else:  # a uv sphere, flattened
            (folder / f"ball{i}.obj").write_text(_surface(*_ball(rng)))


def _grid(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(u, v) in [0, 1] of a grid of points, and its triangles."""
    v, u = np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
    i = np.arange(u.size).reshape(u.shape)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    return u.ravel(), v.ravel(), np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])


def _knot(rng):
    u, v, faces = _grid(24, 300)
    p, q = [(2, 3), (3, 2), (2, 5), (1, 1)][rng.integers(4)]
    centre = lambda t: np.stack(
        [(2 + np.cos(q * t)) * np.cos(p * t), (2 + np.cos(q * t)) * np.sin(p * t), np.sin(q * t)], -1
    )
    t = 2 * np.pi * u
    along = centre(t + 1e-4) - centre(t - 1e-4)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.cross(along, [0, 0, 1.0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, along)
    w = 2 * np.pi * v
    return centre(t) + 0.45 * (np.cos(w)[:, None] * side + np.sin(w)[:, None] * up), np.stack([4 * u, v], 1), faces


def _ball(rng):
    u, v, faces = _grid(60, 90)
    theta, phi = np.pi * np.clip(v, 1e-4, 1 - 1e-4), 2 * np.pi * u
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], 1) * rng.uniform(
        0.5, 1, 3
    )
    return points, np.stack([u, v], 1), faces


def _surface(points, uvs, faces) -> str:
    """Wavefront text."""
    lines = [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in points] + [f"vt {u:.7f} {v:.7f}" for u, v in uvs]
    return "\n".join(lines + [f"f {a}/{a} {b}/{b} {c}/{c}" for a, b, c in faces + 1]) + "\n"


def random_scene(folder: Path, arguments) -> Scene:
    tree = {
        "seed": arguments.seed,
        "camera": {"width": arguments.size[0], "height": arguments.size[1], "fov": 65},
        "scene": {
            "kind": "random",
            "objects": {"count": arguments.objects, "size": [0.6, 2.6], "distance": [2, 12], "flying": 0.7},
            "pool": {"primitives": [], "folders": [str(folder)], "urdfs": False, "test_fraction": 0.0},
            "textures": {"photographs": False},
            "camera_motion": {"speed": [0.2, 1.2], "rotation_rate": [5, 30]},
        },
    }
    config = RunTemplate(tree, folder).sequence(0)
    return build_scene(
        config.scene, config.camera, config.time.t0_ns, config.time.t1_ns, seed=config.seed, sequence=0, base=folder
    )


class Everything(Renderer):
    """No culling: every part is drawn, front and back."""

    def __init__(self, *arguments, **more):
        super().__init__(*arguments, **more)
        for item in self.items:
            item.two_sided = True

    def moment(self, t_ns):
        moment = super().moment(t_ns)
        seen = set(map(id, moment.visible))
        # Behind what is seen, so that the order in which that hides the rest of itself stays.
        moment.visible = moment.visible + [item for item in self.items if id(item) not in seen]
        return moment


def timing(gl, scene: Scene, variants: dict, times: list[int], rounds: int) -> dict[str, dict]:
    """variant -> triangles, ms and processor ms per frame: luminance, and luminance with
    ESIM; medians over interleaved rounds."""
    shape = (scene.camera.height, scene.camera.width)
    out = {}
    made = {}
    for name, (kind, config) in variants.items():
        started = time.perf_counter()
        renderer = kind(gl, scene, config)
        out[name] = {"setup_s": time.perf_counter() - started, "triangles": renderer.triangles}
        made[name] = (
            renderer,
            EventCamera(EsimConfig(contrast_threshold=0.2), None, *shape, 0),
            np.empty(shape, np.float32),
            [],
            [],
            [],
        )
        renderer.luminance(times[0]).read(out=made[name][2])
        renderer.stats.triangles = renderer.stats.frames = 0
    names = list(variants)
    for k in range(rounds):
        t = times[k % len(times)] + (k // len(times)) * (times[-1] - times[0])
        for name in names[k % len(names) :] + names[: k % len(names)]:
            renderer, camera, frame, wall, cpu, both = made[name]
            w, c = time.perf_counter(), time.process_time()
            renderer.luminance(times[k % len(times)]).read(out=frame)
            wall.append(time.perf_counter() - w)
            cpu.append(time.process_time() - c)
            camera.step(EventFrame(t + k, frame))
            both.append(time.perf_counter() - w)
    for name, (renderer, _, _, wall, cpu, both) in made.items():
        out[name] |= {
            "drawn": renderer.stats.triangles / renderer.stats.frames,
            "ms": 1e3 * float(np.median(wall)),
            "cpu_ms": 1e3 * float(np.median(cpu)),
            "with_events_ms": 1e3 * float(np.median(both)),
        }
        renderer.release()
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--objects", type=int, default=10)
    parser.add_argument("--size", type=int, nargs=2, default=[640, 480])
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--edge", type=float, nargs="+", default=[4.0])
    parser.add_argument("--error", type=float, nargs="+", default=[0.25])
    parser.add_argument("--antialiasing", nargs="+", default=["none"])
    parser.add_argument("--frames", type=int, default=60, help="judged against the reference; 0: times only")
    parser.add_argument("--rounds", type=int, default=60)
    parser.add_argument("--max-px", type=float, default=0.5)
    parser.add_argument("--factor", type=int, default=8)
    parser.add_argument("--json")
    arguments = parser.parse_args()
    report: dict = {"arguments": vars(arguments)}
    with tempfile.TemporaryDirectory() as folder, create_context() as gl:
        fine_meshes(Path(folder))
        scene = random_scene(Path(folder), arguments)
        report["machine"] = bench.machine_line(gl.renderer)
        levels = [
            LodConfig(enabled=True, edge_px=edge, error_px=error)
            for edge in arguments.edge
            for error in arguments.error
        ]
        times = displacement_frames(gl, scene, arguments.max_px, max(arguments.frames, arguments.rounds))
        for antialiasing in arguments.antialiasing:
            plain = RenderConfig(antialiasing=antialiasing, image_antialiasing="none")
            settings = {"full meshes": plain} | {
                f"edge {lod.edge_px:g} px, error {lod.error_px:g} px": plain.model_copy(update={"lod": lod})
                for lod in levels
            }
            variants = {"no culling": (Everything, plain)} | {
                name: (Renderer, config) for name, config in settings.items()
            }
            result = report[antialiasing] = {"timing": timing(gl, scene, variants, times, arguments.rounds)}
            if arguments.frames:
                result |= judge(
                    gl,
                    scene,
                    settings,
                    times[: arguments.frames],
                    arguments.factor,
                    10_000,
                    EsimConfig(contrast_threshold=0.2),
                )
            print_table(antialiasing, result, report["machine"])
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(report, indent=1), encoding="utf-8")


def print_table(antialiasing: str, result: dict, machine: str) -> None:
    table = Table(title=f"antialiasing {antialiasing}; {machine}", title_justify="left")
    for column in (
        "meshes",
        "triangles",
        "drawn",
        "set-up s",
        "ms",
        "cpu ms",
        "faster",
        "cpu",
        "with ESIM",
        "events",
        "missed",
        "extra",
        "wrong",
        "moved by",
    ):
        table.add_column(column, justify="left" if column == "meshes" else "right")
    full = result["timing"]["full meshes"]
    judged = result.get("settings", {})
    for name, r in result["timing"].items():
        row = [
            name,
            f"{r['triangles']:,}",
            f"{r['drawn']:,.0f}",
            f"{r['setup_s']:.2f}",
            f"{r['ms']:.2f}",
            f"{r['cpu_ms']:.2f}",
            f"{full['ms'] / r['ms']:.2f}x",
            f"{full['cpu_ms'] / r['cpu_ms']:.2f}x",
            f"{full['with_events_ms'] / r['with_events_ms']:.2f}x",
        ]
        if name in judged:
            j, plain = judged[name], judged["full meshes"]
            wrong, own = j["missed"] + j["extra"], plain["missed"] + plain["extra"]
            row += [
                f"{j['events']:.4f}",
                f"{j['missed']:.4f}",
                f"{j['extra']:.4f}",
                f"{wrong:.4f}",
                f"{100 * (wrong / own - 1):+.1f} %",
            ]
        table.add_row(*row)
    Console(width=190).print(table)


if __name__ == "__main__":
    main()
