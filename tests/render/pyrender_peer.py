"""The same scene through pyrender: an independent rasteriser to check pictures against.

    images = render(scene, [t_ns])          # colour, depth and ids of each time

pyrender makes its own OpenGL context through PyOpenGL, which must not meet ours in one process: the scene is written
to an .npz of plain arrays and drawn by this file run as a program (``pyrender_peer.py JOB.npz RESULT.npz``).

What pyrender does, as found by reading and trying version 0.1.45, and what is done about it here:

* FLAT colour is ``texture * base_color``, clamped, in whatever encoding the texture has: no sRGB decoding and none
  after. Textures become 8-bit. So textures are handed over as **linear** bytes, and its colours are linear * 255; a
  texture that is 8-bit sRGB here is rounded once more on the way.
* Every picture is drawn 4x multi-sampled, and the depth that comes back is that of one of the samples, not of the pixel
  centre: wrong by up to 3/8 px on a slant. The SEG flag turns multi-sampling off, so
  depth and ids come from a SEG pass.
* SEG culls back faces whatever the material says: two-sided surfaces are handed over with every face doubled.
* Depth is a 24-bit standard depth buffer, linearised in float32. With an infinite far plane its step is
  2^-24 Z / near relative to Z: choose ``near`` close to the nearest thing (``near`` argument) to read depth.
* Texture row 0 is turned to the bottom on upload, hence v -> 1 - v. Its principal point is measured from the image's
  corner, ours from the first pixel's centre: + 0.5.
* It uses ``np.infty``, which NumPy 2 dropped.

``example(pyrender)`` is a scene of pyrender's own, which :meth:`blinkgl.Scene.from_pyrender` takes; ``own()`` is what
pyrender makes of it.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from blinkgl.machine.extras import install

if TYPE_CHECKING:
    from blinkgl.scene.types import Scene

_GL_CAMERA = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL looks along -z with y up


def available() -> str:
    """'' when pyrender can be used, else what is missing and the command that mends it."""
    missing = [name for name in ("pyrender", "OpenGL") if importlib.util.find_spec(name) is None]
    return (
        f"{' and '.join(missing)} not installed: run {install(*missing).replace(' OpenGL', ' PyOpenGL')}"
        if missing
        else ""
    )


def render(scene: Scene, times_ns, near: float | None = None) -> dict[str, np.ndarray]:
    """colour (N, H, W, 3) uint8 linear * 255, depth (N, H, W) float32 (0: nothing), ids (N, H, W) uint32.

    colour ignores the light (compare with unlit scenes). near : near plane for pyrender, default the camera's.
    Raises RuntimeError with pyrender's last words when it fails.
    """
    return _run(scene, times_ns, near)


def export(scene: Scene, times_ns, near: float | None = None, double: bool = True, **more) -> dict[str, np.ndarray]:
    """The scene as plain arrays: geometry once, poses for each time. double : two faces for
    one of a two-sided surface."""
    camera, arrays = scene.camera, {}
    parts = [(thing, part) for thing in scene.objects for part in thing.parts]
    for k, (_, part) in enumerate(parts):
        mesh, paint = part.mesh, part.material
        two_sided = not part.culled
        faces = np.concatenate([mesh.faces, mesh.faces[:, ::-1]]) if two_sided and double else mesh.faces
        uv = mesh.uvs.astype(np.float64) * paint.uv_scale
        arrays[f"vertices{k}"] = mesh.vertices.astype(np.float32)
        arrays[f"faces{k}"] = faces.astype(np.uint32)
        arrays[f"uvs{k}"] = np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1).astype(np.float32)
        arrays[f"two_sided{k}"] = np.array(two_sided)
        arrays[f"base{k}"] = np.array([*paint.base_color, 1.0])
        if paint.texture is not None:
            arrays[f"texture{k}"] = _linear_bytes(paint.texture.image)
    times_ns = np.asarray(times_ns, np.int64)
    # relative to the first camera: pyrender multiplies its matrices in float32
    origin = scene.camera_path.pose(int(times_ns[0]))[:3, 3]

    def poses(path):
        stack = path.poses(times_ns).copy()
        stack[:, :3, 3] -= origin
        return stack

    return {
        **arrays,
        **more,
        "ids": np.array([thing.instance_id for thing, _ in parts], np.uint32),
        "poses": np.array([poses(thing.path) for thing, _ in parts]),
        "camera_poses": poses(scene.camera_path) @ _GL_CAMERA,
        "intrinsics": np.array([camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5, near or camera.near]),
        "size": np.array([camera.width, camera.height]),
        "background": np.array(float(scene.background)),
    }


def _linear_bytes(image: np.ndarray) -> np.ndarray:
    if image.dtype == np.uint8:
        code = image / 255.0
        image = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    return np.rint(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)


def _run(scene: Scene, times_ns, near) -> dict[str, np.ndarray]:
    return _start("", export(scene, times_ns, near))


def _start(job_name: str, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    with tempfile.TemporaryDirectory(prefix="blinkgl-peer-") as folder:
        job, answer = Path(folder) / "job.npz", Path(folder) / "answer.npz"
        np.savez(job, **arrays)
        # PYGLET_HEADLESS: pyrender imports its viewer, which otherwise wants all of X11 where there is some of it.
        environment = {"PYOPENGL_PLATFORM": "egl", "PYGLET_HEADLESS": "1", **os.environ}
        command = [sys.executable, str(Path(__file__).resolve()), job_name or str(job), str(answer)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        if done.returncode:
            words = done.stderr.strip().splitlines() or ["no message"]
            raise RuntimeError(f"pyrender failed: {words[-1]}")
        with np.load(answer, allow_pickle=False) as result:
            return {name: result[name] for name in result.files}


# ------------------------------------------------------------------------------------------------- the other process


def _main(job_path: str, answer_path: str) -> None:
    pyrender = imported()
    if job_path == "example":
        np.savez(answer_path, **_drawn(pyrender, example(pyrender), (WIDTH, HEIGHT)))
        return

    with np.load(job_path, allow_pickle=False) as stored:
        job = {name: stored[name] for name in stored.files}
    fx, fy, cx, cy, near = job["intrinsics"]
    width, height = (int(n) for n in job["size"])
    background = [*(float(job["background"]),) * 3, 1.0]
    world = pyrender.Scene(bg_color=background)
    nodes = [world.add(pyrender.Mesh([_primitive(pyrender, job, k)])) for k in range(len(job["ids"]))]
    camera = pyrender.IntrinsicsCamera(fx, fy, cx, cy, znear=near)
    camera._zfar = None
    eye = world.add(camera)
    frames = []
    for n in range(len(job["camera_poses"])):
        for k, node in enumerate(nodes):
            world.set_pose(node, job["poses"][k, n])
        world.set_pose(eye, job["camera_poses"][n])
        frames.append(_drawn(pyrender, world, (width, height), dict(zip(nodes, job["ids"]))))
    np.savez(answer_path, **{key: np.array([frame[key] for frame in frames]) for key in frames[0]})


def _drawn(pyrender, world, size, ids=None) -> dict[str, np.ndarray]:
    """FLAT colour, lit colour, depth and ids (from 1 in the order of nodes)."""
    ids = ids or {node: k for k, node in enumerate((n for n in world._digraph if n in world.mesh_nodes), start=1)}
    # 24 bits of id in three 8-bit colour channels
    codes = {node: [int(i) >> shift & 255 for shift in (16, 8, 0)] for node, i in ids.items()}
    renderer = pyrender.OffscreenRenderer(*size)
    colour = renderer.render(world, pyrender.RenderFlags.FLAT)[0]
    lit = renderer.render(world)[0]
    code, depth = renderer.render(world, pyrender.RenderFlags.SEG, codes)
    renderer.delete()
    return {
        "colour": colour,
        "lit": lit,
        "depth": depth,
        "ids": code.astype(np.uint32) @ np.array([65536, 256, 1], np.uint32),
    }


WIDTH, HEIGHT = 160, 120


def imported():
    """pyrender, for programs that may draw with it and for those that only read its objects."""
    os.environ |= {"PYOPENGL_PLATFORM": "egl", "PYGLET_HEADLESS": "1"}
    np.infty = np.inf  # noqa: NPY201 - which pyrender uses and NumPy 2 does not have
    import pyrender

    return pyrender


def own() -> dict[str, np.ndarray]:
    """What pyrender makes of its example: colour, lit, depth, ids."""
    return _start("example", {})


def example(pyrender):
    """A scene as users of pyrender write it: nodes with poses and scales, a mesh with two primitives, instances,
    colours of vertices, a texture, a lens off the middle, and a sun."""
    turn = lambda *euler: Rotation.from_euler("xyz", euler, degrees=True).as_matrix()

    def pose(at, axes=((1, 0, 0), (0, 1, 0), (0, 0, 1))):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = axes, at
        return T

    matt = dict(metallicFactor=0.0, roughnessFactor=1.0)
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    quad = dict(positions=corners, indices=np.array([[0, 1, 2], [0, 2, 3]], np.uint32), mode=4)
    rng = np.random.default_rng(5)
    picture = np.kron(rng.integers(0, 256, (4, 4, 3)), np.ones((16, 16, 1))).astype(np.uint8)
    texture = pyrender.Texture(
        source=picture, source_channels="RGB", sampler=pyrender.Sampler(wrapS=10497, wrapT=10497)
    )
    grid = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    pictured = pyrender.MetallicRoughnessMaterial(baseColorTexture=texture, doubleSided=True, **matt)
    red = pyrender.MetallicRoughnessMaterial(baseColorFactor=[0.8, 0.1, 0.2, 1.0], doubleSided=True, **matt)
    white = pyrender.MetallicRoughnessMaterial(baseColorFactor=[1.0, 1.0, 1.0, 1.0], doubleSided=True, **matt)
    tinted = np.array([[1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1], [1, 1, 1, 1]], np.float32)
    small = np.stack([pose((x, -1.4, 0.5), 0.3 * np.eye(3)) for x in (-1.5, 0, 1.5)]).astype(np.float32)
    world = pyrender.Scene(bg_color=[0.25, 0.25, 0.25, 1.0])
    world.add(
        pyrender.Mesh([pyrender.Primitive(**quad, texcoord_0=grid, material=pictured)]),
        pose=pose((0, 0, -2), 2 * turn(0, 20, 0)),
    )
    world.add(
        pyrender.Mesh([pyrender.Primitive(**quad, material=red)]),
        pose=pose((-1, 0.3, 0), turn(30, 40, 10) * [1, 0.5, 1]),
    )
    world.add(
        pyrender.Mesh([pyrender.Primitive(**quad, material=white, color_0=tinted)]),
        pose=pose((1, 0.5, 0), 0.6 * turn(-20, -30, 0)),
    )
    world.add(pyrender.Mesh([pyrender.Primitive(**quad, material=red, poses=small)]), name="small")
    place = pose((0.3, 0.2, 5), turn(-3, 4, 0))
    world.add(pyrender.IntrinsicsCamera(150.0, 140.0, 84.0, 57.0, znear=2.0, zfar=50.0), pose=place)
    world.add(pyrender.DirectionalLight(color=[1.0, 0.9, 0.8], intensity=2.0), pose=pose((0, 0, 0), turn(-25, 15, 0)))
    return world


def _primitive(pyrender, job, k):
    texture = job.get(f"texture{k}")
    if texture is not None:
        repeat = pyrender.Sampler(wrapS=10497, wrapT=10497)
        texture = pyrender.Texture(source=texture, source_channels="RGB", sampler=repeat)
    paint = pyrender.MetallicRoughnessMaterial(
        baseColorFactor=job[f"base{k}"], baseColorTexture=texture, doubleSided=bool(job[f"two_sided{k}"])
    )
    return pyrender.Primitive(
        positions=job[f"vertices{k}"], indices=job[f"faces{k}"], material=paint, mode=4,
        texcoord_0=job[f"uvs{k}"] if texture is not None else None,
    )  # fmt: skip


if __name__ == "__main__":
    _main(*sys.argv[1:])
