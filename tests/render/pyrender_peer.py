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
    assert not any(thing.deforms for thing in scene.objects), "pyrender draws rigid bodies"
    camera, arrays = scene.camera, {}
    parts = [(thing, part) for thing in scene.objects for part in thing.parts]
    for k, (_, part) in enumerate(parts):
        mesh, paint = part.mesh, part.material
        two_sided = paint.double_sided or not mesh.closed
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
    with tempfile.TemporaryDirectory(prefix="blinkgl-peer-") as folder:
        job, answer = Path(folder) / "job.npz", Path(folder) / "answer.npz"
        np.savez(job, **export(scene, times_ns, near))
        # PYGLET_HEADLESS: pyrender imports its viewer, which otherwise wants all of X11 where there is some of it.
        environment = {"PYOPENGL_PLATFORM": "egl", "PYGLET_HEADLESS": "1", **os.environ}
        command = [sys.executable, str(Path(__file__).resolve()), str(job), str(answer)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        if done.returncode:
            words = done.stderr.strip().splitlines() or ["no message"]
            raise RuntimeError(f"pyrender failed: {words[-1]}")
        with np.load(answer, allow_pickle=False) as result:
            return {name: result[name] for name in result.files}


# ------------------------------------------------------------------------------------------------- the other process


def _main(job_path: str, answer_path: str) -> None:
    np.inf = np.inf
    import pyrender

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
    # 24 bits of id in three 8-bit colour channels
    codes = {node: [int(i) >> shift & 255 for shift in (16, 8, 0)] for node, i in zip(nodes, job["ids"])}
    renderer = pyrender.OffscreenRenderer(width, height)

    def place(n):
        for k, node in enumerate(nodes):
            world.set_pose(node, job["poses"][k, n])
        world.set_pose(eye, job["camera_poses"][n])

    frames = len(job["camera_poses"])
    colour, depth, ids = [], [], []
    for n in range(frames):
        place(n)
        colour.append(renderer.render(world, pyrender.RenderFlags.FLAT)[0])
        code, distance = renderer.render(world, pyrender.RenderFlags.SEG, codes)
        depth.append(distance)
        ids.append(code.astype(np.uint32) @ np.array([65536, 256, 1], np.uint32))
    answer = {"colour": np.array(colour), "depth": np.array(depth), "ids": np.array(ids)}
    renderer.delete()
    np.savez(answer_path, **answer)


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
