"""What shapes that change with time cost: a luminance frame of flying_objects with two figures of 5,000 vertices that
dance, against the same scene with them standing rigid.

    python -m blinkgl.tools.bench_deform [--frames 60] [--rounds 6] [--json FILE]

The figures are tubes on chains of 21 joints, four joints to a vertex, in the camera's view at its first place. Both
scenes take turns of ``--frames`` frames each; times are processor time of the process, all threads together, per frame
drawn and read back, of the quickest turn: what else the machine does can only add to it. Formulas (wave, twist …)
on the same two figures are timed the same way.
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

from blinkgl.config.deform import DeformConfig
from blinkgl.config.sequence import load_run
from blinkgl.gl import create_context
from blinkgl.machine import bench
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import sequence_scene
from blinkgl.scene.geometry.meshes import make_mesh
from blinkgl.scene.motion.paths import StaticPath
from blinkgl.scene.shapes.skeleton import Locals, Skeleton
from blinkgl.scene.shapes.skin import Skin
from blinkgl.scene.shapes.table import deformer_of
from blinkgl.scene.types import Material, Mesh, Part, Scene, SceneObject

RINGS, ROUND, JOINTS = 100, 50, 21
HEIGHT, RADIUS = 1.8, 0.25


class Dance:
    """Every joint of a chain swings about an axis of its own."""

    period_ns = span_ns = 1_000_000_000
    is_static = False

    def locals(self, t_ns: int) -> Locals:
        out = Locals.rest(JOINTS)
        out.translation[1:, 2] = HEIGHT / JOINTS
        phase = 2 * np.pi * ((t_ns % self.period_ns) * 1e-9 + np.arange(JOINTS) / JOINTS)
        half, rate = 0.06 * np.sin(phase), 0.06 * 2 * np.pi * np.cos(phase)
        axes = np.stack([np.cos(np.arange(JOINTS)), np.sin(np.arange(JOINTS)), np.zeros(JOINTS)], axis=1)
        out.rotation[:, :3], out.rotation[:, 3] = np.sin(half)[:, None] * axes, np.cos(half)
        out.d_rotation[:, :3], out.d_rotation[:, 3] = (rate * np.cos(half))[:, None] * axes, -rate * np.sin(half)
        return out


def figure() -> Mesh:
    """A tube of 5,000 vertices along z."""
    turn = np.arange(ROUND) / ROUND * 2 * np.pi
    z = np.repeat(np.linspace(0, HEIGHT, RINGS), ROUND)
    radius = RADIUS * (0.7 + 0.3 * np.sin(9 * z))
    vertices = np.stack([radius * np.cos(np.tile(turn, RINGS)), radius * np.sin(np.tile(turn, RINGS)), z], axis=1)
    ring, k = np.divmod(np.arange((RINGS - 1) * ROUND), ROUND)
    a, b = ring * ROUND + k, ring * ROUND + (k + 1) % ROUND
    faces = np.concatenate([np.stack([a, b, b + ROUND], 1), np.stack([a, b + ROUND, a + ROUND], 1)])
    uvs = np.stack([np.tile(turn, RINGS) / np.pi, z], axis=1)
    normals = np.stack([np.cos(np.tile(turn, RINGS)), np.sin(np.tile(turn, RINGS)), 0 * z], axis=1)
    return make_mesh(vertices, faces, normals=normals, uvs=uvs, name="figure")


def skinned(mesh: Mesh) -> Mesh:
    bind = np.tile(np.eye(4), (JOINTS, 1, 1))
    bind[:, 2, 3] = -np.arange(JOINTS) * HEIGHT / JOINTS
    away = np.abs(mesh.vertices[:, 2:] - np.arange(JOINTS) * HEIGHT / JOINTS)
    joints = np.argsort(away, axis=1)[:, :4]
    weights = 1 / (0.02 + np.take_along_axis(away, joints, axis=1))
    skeleton = Skeleton(np.arange(JOINTS) - 1, Dance())
    return replace(mesh, deformer=Skin(skeleton, np.arange(JOINTS), bind, joints, weights))


def by_formula(mesh: Mesh, kind: str) -> Mesh:
    config = DeformConfig.members.models[kind]()
    return replace(mesh, deformer=deformer_of(config, mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)))


def with_figures(scene: Scene, mesh: Mesh, material: Material) -> Scene:
    """Two of them, three metres before the camera's first place."""
    eye = scene.camera_path.pose(scene.t0_ns)
    objects = list(scene.objects)
    for k, side in enumerate((-0.7, 0.7)):
        T = np.eye(4)
        T[:3, 3] = eye[:3, :3] @ [side, 0.0, 3.0] + eye[:3, 3] - [0, 0, HEIGHT / 2]
        path = StaticPath(T, scene.t0_ns, scene.t1_ns)
        objects.append(SceneObject(f"figure-{k}", len(objects) + 1, (Part(mesh, material),), path))
    return replace(scene, objects=tuple(objects))


def processor_ms(renderers: dict[str, Renderer], t0_ns: int, frames: int, rounds: int) -> dict[str, list[float]]:
    """Per frame, of each in turns, a number per round."""
    found: dict[str, list[float]] = {name: [] for name in renderers}
    for renderer in renderers.values():
        renderer.luminance(t0_ns).read()
    for turn in range(rounds):
        times = [t0_ns + (turn * frames + k) * 500_000 for k in range(frames)]
        for name, renderer in renderers.items():
            started = time.process_time()
            for t in times:
                renderer.luminance(t).read()
            found[name].append((time.process_time() - started) / frames * 1e3)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=60, help="per turn (default 60)")
    parser.add_argument("--rounds", type=int, default=6, help="turns of each (default 6)")
    parser.add_argument("--kinds", nargs="*", default=["skin", *DeformConfig.members.models])
    parser.add_argument("--json", metavar="FILE", help="write the figures as JSON, too")
    a = parser.parse_args()
    config = load_run(str(resources.files("blinkgl.configs") / "flying_objects.yaml")).sequence(0)
    scene, mesh = sequence_scene(config, 0), figure()
    material = next(part.material for o in scene.objects if o.category == "object" for part in o.parts)
    meshes = {"rigid": mesh} | {k: skinned(mesh) if k == "skin" else by_formula(mesh, k) for k in a.kinds}
    with create_context() as gl:
        made = {k: Renderer(gl, with_figures(scene, m, material), config.render) for k, m in meshes.items()}
        found = processor_ms(made, scene.t0_ns, a.frames, a.rounds)
        machine = bench.machine_line(gl.renderer)
    least = {k: min(v) for k, v in found.items()}
    rows = {k: {"ms": v, "ratio": v / least["rigid"], "vertices": len(mesh.vertices)} for k, v in least.items()}
    table = Table(title=machine)
    for name in ("two figures", "processor ms per frame", "against rigid"):
        table.add_column(name)
    for name, row in rows.items():
        table.add_row(name, f"{row['ms']:.2f}", f"{row['ratio']:.3f}")
    Console().print(table)
    if a.json:
        with open(a.json, "w", encoding="utf-8") as file:
            json.dump({"machine": machine, "rows": rows}, file, indent=1)


if __name__ == "__main__":
    main()
