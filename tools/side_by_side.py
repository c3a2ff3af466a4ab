"""Draw mesh files of ten kinds beside pyrender, which reads them through trimesh, into one contact sheet.

    python -m blinkgl.tools.side_by_side SHEET.png [FOLDER]        (extra pyrender)

Files of FOLDER (whatever BlinkGL reads: a sheet of ten files of a kind, say), else ten that are written here: a bent
sheet in each format, with colours of vertices and with pictures where the format has them. Above BlinkGL, below
pyrender, and the share of pixels that differ by more than a tenth.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

import blinkgl
from blinkgl.errors import BlinkGLError
from blinkgl.machine.extras import install
from blinkgl.scene.importing.mesh_files import MESH_SUFFIXES
from blinkgl.srgb import to_srgb8

SIZE = 160
FOCAL = 1.6 * SIZE
GREY = 0.25


def bent_sheet(pictured: bool) -> trimesh.Trimesh:
    """Return a sheet of 2 x 2, bent along both axes, with the colours of its vertices or a picture's coordinates."""
    u, v = (axis.ravel() for axis in np.meshgrid(np.linspace(0, 1, 25), np.linspace(0, 1, 25)))
    points = np.stack([2 * u - 1, 2 * v - 1, 0.3 * np.sin(6 * u) * np.cos(4 * v)], axis=1)
    corner = np.arange(24 * 25).reshape(24, 25)[:, :24].ravel()
    faces = np.concatenate([corner[:, None] + [0, 1, 26], corner[:, None] + [0, 26, 25]])
    if not pictured:
        codes = np.stack([255 * u, 255 * v, 255 * (1 - u), np.full(len(u), 255)], axis=1).astype(np.uint8)
        return trimesh.Trimesh(points, faces, vertex_colors=codes, process=False)
    picture = Image.fromarray(np.random.default_rng(3).integers(30, 255, (8, 8, 3)).astype(np.uint8))
    material = trimesh.visual.material.SimpleMaterial(image=picture.resize((128, 128), Image.Resampling.NEAREST))
    visual = trimesh.visual.TextureVisuals(np.stack([u, v], axis=1), material=material)
    return trimesh.Trimesh(points, faces, visual=visual, process=False)


def written(folder: Path) -> list[Path]:
    """Write a file of each of ten kinds; return their paths."""
    coloured, pictured = bent_sheet(False), bent_sheet(True)
    shapenet = folder / "02691156/1021/models"
    for place in (shapenet, shapenet.parent / "images"):
        place.mkdir(parents=True)
    plain = trimesh.Trimesh(coloured.vertices, coloured.faces, process=False)
    files = [folder / name for name in ("plain.obj", "coloured.ply", "plain.stl", "plain.off", "plain.3mf")]
    for file, mesh in zip(files, (plain, coloured, plain, plain, plain), strict=True):
        mesh.export(file)
    for name, mesh in (("coloured.obj", coloured), ("coloured.glb", coloured), ("pictured.glb", pictured)):
        mesh.export(folder / name)
        files.append(folder / name)
    (folder / "gltf").mkdir()
    for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(pictured)).items():
        (folder / "gltf" / name).write_bytes(data)
    # ShapeNetCore.v2: the picture lies beside the folder of the mesh.
    looks: Any = pictured.visual
    looks.material.image.save(shapenet.parent / "images/texture0.jpg", quality=95)
    rows = ["mtllib model.mtl", *("v {} {} {}".format(*p) for p in pictured.vertices)]
    rows += ["vt {} {}".format(*p) for p in looks.uv]
    rows += ["usemtl m", *("f {0}/{0} {1}/{1} {2}/{2}".format(*f) for f in pictured.faces + 1)]
    (shapenet / "model.obj").write_text("\n".join(rows) + "\n")
    (shapenet / "model.mtl").write_text("newmtl m\nKd 1 1 1\nmap_Kd ../images/texture0.jpg\n")
    return [*files, folder / "gltf/model.gltf", shapenet / "model.obj"]


def camera_of(file: Path) -> np.ndarray:
    """Return T_world_cam, (4, 4), OpenCV axes: the whole file from obliquely above, its z upwards."""
    low, high = trimesh.load_scene(file).bounds
    centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    away = np.array([0.35, -0.75, 0.56]) / np.linalg.norm([0.35, -0.75, 0.56])
    right = np.cross(-away, [0.0, 0.0, 1.0]) / np.linalg.norm(away[:2])
    T_world_cam = np.eye(4)
    T_world_cam[:3] = np.stack([right, np.cross(-away, right), -away, centre + 3.2 * radius * away], axis=1)
    return T_world_cam


def ours(file: Path, T_world_cam: np.ndarray) -> np.ndarray:
    """Return BlinkGL's picture, (SIZE, SIZE, 3) uint8, without light; a cross where it refuses the file."""
    turn = Rotation.from_matrix(T_world_cam[:3, :3]).as_quat(scalar_first=True)
    camera = blinkgl.Camera(SIZE, SIZE, focal=FOCAL, pose=blinkgl.Pose(T_world_cam[:3, 3], quaternion=turn))
    light = blinkgl.Light(unlit=True)
    try:
        scene = blinkgl.Scene(camera, [blinkgl.Mesh(file, up="z")], light=light, background=GREY)
        with blinkgl.Renderer(scene) as renderer:
            colour = renderer.frame(0.0, ["images"]).colour
            assert colour is not None
            return to_srgb8(colour)
    except BlinkGLError as error:
        print(error)
        return cv2.line(np.zeros((SIZE, SIZE, 3), np.uint8), (0, 0), (SIZE, SIZE), (255, 0, 0), 3)


def theirs(job: str, answer: str) -> None:
    """Draw the files of a job by pyrender, in a process of its own: two kinds of OpenGL contexts must not meet."""
    os.environ |= {"PYOPENGL_PLATFORM": "egl", "PYGLET_HEADLESS": "1"}
    np.infty = np.inf  # type: ignore[missing-attribute]  # noqa: NPY201 - pyrender uses it, and NumPy 2 lacks it
    pyrender: Any = import_module("pyrender")
    tasks, pictures = np.load(job), []
    for file, T_world_cam in zip(tasks["files"].tolist(), tasks["poses"], strict=True):
        code = float(to_srgb8(np.full(1, GREY, np.float32))[0]) / 255
        world = pyrender.Scene.from_trimesh_scene(trimesh.load_scene(file), bg_color=[code, code, code, 1.0])
        for mesh in world.meshes:
            for primitive in mesh.primitives:
                primitive.material.doubleSided = True
        centre = (SIZE - 1) / 2 + 0.5
        lens = pyrender.IntrinsicsCamera(FOCAL, FOCAL, centre, centre, znear=0.01)
        world.add(lens, pose=T_world_cam @ np.diag([1.0, -1.0, -1.0, 1.0]))
        renderer = pyrender.OffscreenRenderer(SIZE, SIZE)
        pictures.append(renderer.render(world, pyrender.RenderFlags.FLAT)[0])
        renderer.delete()
    np.save(answer, np.array(pictures))


def main(sheet: str, folder: str | None = None) -> int:
    """Write the contact sheet; return 0, or 2 without pyrender."""
    if find_spec("pyrender") is None:
        print(f"error: no pyrender; {install('pyrender')}", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch)
        kinds = sorted(p for p in Path(folder or ".").rglob("*") if p.suffix.lower() in MESH_SUFFIXES)
        files = kinds if folder else written(place)
        poses = np.array([camera_of(file) for file in files])
        np.savez(place / "job.npz", files=[str(file) for file in files], poses=poses)
        with contextlib.chdir(place):  # the border of what a mesh may name
            own = np.array([ours(file, pose) for file, pose in zip(files, poses, strict=True)])
        words = [sys.executable, __file__, "--theirs", str(place / "job.npz"), str(place / "answer.npy")]
        subprocess.run(words, check=True)
        peer = np.load(place / "answer.npy")
    apart = (np.abs(own.astype(int) - peer).max(axis=3) > 25).mean(axis=(1, 2))
    for file, share in zip(files, apart.tolist(), strict=True):
        print(f"{file.parent.name}/{file.name}: {share:.1%} of the pixels differ")
    rows = [np.concatenate([own[k : k + 5], peer[k : k + 5]], axis=1) for k in range(0, len(files), 5)]
    pad = [np.concatenate([*row, *np.zeros((5 - len(row), 2 * SIZE, SIZE, 3), np.uint8)], axis=1) for row in rows]
    cv2.imwrite(sheet, np.concatenate(pad)[..., ::-1])
    return 0


if __name__ == "__main__":
    theirs(*sys.argv[2:]) if sys.argv[1] == "--theirs" else sys.exit(main(*sys.argv[1:]))
