"""A peer's models, one a feature, through both doors: colour, depth, normals and flow against a caster of its own."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy import ndimage

from blinkgl.camera import PinHole
from blinkgl.config.camera import CameraConfig
from blinkgl.config.deform import AnimationConfig
from blinkgl.config.scene import PoolConfig, RandomSceneConfig
from blinkgl.config.sequence import RenderConfig
from blinkgl.labels import LabelRequest
from blinkgl.render import casting
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import build_scene
from blinkgl.scene.importing import gltf
from blinkgl.scene.importing.mesh_files import clip_of, load_asset
from blinkgl.scene.motion.paths import StaticPath
from blinkgl.scene.rig import Rig
from blinkgl.scene.types import Scene, SceneObject
from blinkgl.scene.worlds.from_file import dressed, from_document
from blinkgl.scene.worlds.pool import object_pool
from tests.scene.gltf_oracle import Oracle, Surface, cast
from tests.scene.peer_models import MODELS, Models, cube

W, H, FOCAL = 64, 48, 55.0
CAMERA = PinHole.centred(W, H, FOCAL, near=0.05)
END = 10 * 10**9


def pose() -> np.ndarray:
    """The camera at (-2, -3, 1.5), looking at the origin of the z-up world."""
    T = np.eye(4)
    z = np.array([2.0, 3, -1.5]) / np.linalg.norm([2.0, 3, -1.5])
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    T[:3, :3], T[:3, 3] = np.column_stack([x, np.cross(z, x), z]), (-2, -3, 1.5)
    return T


def scenes(path, play: AnimationConfig | None):
    """The file as a scene of its own, and as one object of a scene."""
    rig = Rig.alone(CAMERA, StaticPath(pose(), 0, END))
    document = gltf.read(path)
    yield from_document(document, CAMERA, 0, END, camera_path=rig.path, animation=play)
    asset = load_asset(path, play=None if play is None else clip_of(play))
    yield Scene((SceneObject("asset", 1, asset.parts, StaticPath(None, 0, END)),), rig, 0, END)


@pytest.mark.parametrize("name", MODELS)
def test_a_model_is_drawn_as_its_file_says(name, gl, tmp_path):
    builder, T, model = Models(), pose(), MODELS[name]
    model.build(builder)
    path = builder.write(tmp_path / "a.glb")
    at, to, play = model.at, model.to, model.play
    oracle = Oracle(builder.tree, builder.data, None if play is None else 0)
    now, then = (oracle.surfaces(t) for t in model.true or (at, to))
    y, x = np.mgrid[0:H, 0:W]
    rays = np.stack([(x - (W - 1) / 2) / FOCAL, (y - (H - 1) / 2) / FOCAL, np.ones((H, W))], axis=-1).reshape(-1, 3)
    seen = cast(oracle, now, T, rays @ T[:3, :3].T, CAMERA.near, culls=True)
    hit = np.isfinite(seen.depth)
    assert hit.sum() > 60
    flow = np.zeros((H * W, 2))
    for i in np.flatnonzero(hit):
        s = then[seen.surface[i]]
        same = now[seen.surface[i]].F[seen.face[i]]  # a mirror image has the same corners in another order
        p = (seen.bary[i] @ s.P[same] - T[:3, 3]) @ T[:3, :3]
        flow[i] = p[:2] / p[2] * FOCAL + [(W - 1) / 2, (H - 1) / 2] - [x.flat[i], y.flat[i]]
    # Pixels all of whose neighbours show the same surface smoothly: no edge, and no border of two texels.
    face = np.where(hit, seen.surface * 1000 + seen.face // 2, -1).reshape(H, W)
    inner = np.ones((H, W), bool)
    for dy, dx in ((0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1)):
        inner &= np.roll(face, (dy, dx), (0, 1)) == face
    inner[[0, -1]], inner[:, [0, -1]] = False, False
    colour = seen.colour.reshape(H, W, 3)
    spread = ndimage.maximum_filter(colour, (5, 5, 1)) - ndimage.minimum_filter(colour, (5, 5, 1))
    even = inner & (spread.max(axis=2) < 0.02)
    for door, scene in zip(("scene", "mesh"), scenes(path, play), strict=True):
        with Renderer(
            gl, replace(dressed(scene, unlit=True), background=0.0), RenderConfig(image_antialiasing="none")
        ) as r:
            ends = round(to * 1e9), round(at * 1e9)
            frame = r.labels(round(at * 1e9), LabelRequest("depth", "normals", "flow_forward"), *ends)
            drawn_colour = r.colour(round(at * 1e9)).read()
        cast_too = casting.cast(scene, round(at * 1e9))  # which decides what hides what
        assert (cast_too.hit != hit).sum() <= 12, door
        same = cast_too.hit & hit
        assert (np.abs(cast_too.depth[same] / seen.depth[same] - 1) > 1e-6).sum() <= 12, door
        drawn = np.isfinite(frame.depth)
        assert (drawn != hit.reshape(H, W)).sum() <= 12, door
        both = (inner & hit.reshape(H, W)).ravel()
        assert both.sum() > 25
        assert np.abs(frame.depth.ravel()[both] / seen.depth[both] - 1).max() < 1e-3, door
        # A normal that looks away from the camera is bent until it does not.
        normal, ray = seen.normal[both] @ T[:3, :3], rays[both] / np.linalg.norm(rays[both], axis=1)[:, None]
        normal = normal - np.maximum((normal * ray).sum(axis=1), 0)[:, None] * ray
        facing = (frame.normals.reshape(-1, 3)[both] * normal).sum(axis=1) / np.linalg.norm(normal, axis=1)
        assert facing.min() > 0.998, (door, facing.min())
        off = np.linalg.norm(frame.forward.flow.reshape(-1, 2)[both] - flow[both], axis=1)
        assert off.max() < 2e-3 * (1 + np.abs(flow[both]).max()), (door, off.max())
        assert even.sum() > 5, door
        assert np.abs(drawn_colour[even] - colour[even]).max() < 0.02, door


ATLAS = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0], [0, 255, 255], [255, 0, 255]], np.uint8)


def dice(folder, form="tri"):
    """A cube whose faces show one colour each of an atlas, as exporters write it: shared positions, corners apart."""
    Image.fromarray(ATLAS.reshape(2, 3, 3).repeat(32, 0).repeat(32, 1)).save(folder / "atlas.png")
    (folder / "d.mtl").write_text("newmtl m\nKd 1 1 1\nmap_Kd atlas.png\n")
    points, faces, normals, uvs = cube()
    places, first = np.unique(points.round(6), axis=0, return_inverse=True)
    uvs = (uvs * 0.8 + 0.1 + np.array([(k % 3, 1 - k // 3) for k in range(6)]).repeat(4, 0)) / (3, 2)
    lines = ["mtllib d.mtl", "usemtl m", "s off"]
    lines += ["v {:g} {:g} {:g}".format(*p) for p in places] + ["vt {:g} {:g}".format(*t) for t in uvs]
    lines += ["vn {:g} {:g} {:g}".format(*n) for n in normals[::4]]
    corner = lambda k: f"{first.ravel()[k] + 1}/{k + 1}/{k // 4 + 1}"
    rows = faces if form == "tri" else np.arange(24).reshape(6, 4)
    (folder / "d.obj").write_text("\n".join(lines + ["f " + " ".join(map(corner, row)) for row in rows]) + "\n")
    return folder / "d.obj"


@pytest.mark.parametrize("form", ["tri", "quads"])
def test_seams_of_an_obj(form, gl, tmp_path):
    points, faces, normals, _ = cube()
    oracle = Oracle({"nodes": [], "materials": []}, b"")
    surface = Surface(points, normals, faces, None, np.ones((24, 3)), {})
    T, (y, x) = pose(), np.mgrid[0:H, 0:W]
    rays = np.stack([(x - (W - 1) / 2) / FOCAL, (y - (H - 1) / 2) / FOCAL, np.ones((H, W))], axis=-1).reshape(-1, 3)
    seen = cast(oracle, [surface], T, rays @ T[:3, :3].T, CAMERA.near, culls=False)
    asset = load_asset(dice(tmp_path, form))
    rig = Rig.alone(CAMERA, StaticPath(T, 0, END))
    made = Scene((SceneObject("dice", 1, asset.parts, StaticPath(None, 0, END)),), rig, 0, END)
    with Renderer(gl, replace(dressed(made, unlit=True), background=0.0), RenderConfig(image_antialiasing="none")) as r:
        frame = r.labels(0, LabelRequest("depth", "normals"), None, None)
        colour = r.colour(0).read()
    hit = np.isfinite(seen.depth)
    inner = ndimage.minimum_filter(hit.reshape(H, W), 3) & (ndimage.generic_gradient_magnitude(
        seen.face.reshape(H, W) // 2.0, ndimage.sobel) == 0)  # fmt: skip
    assert inner.sum() > 100 and len(np.unique(seen.face.reshape(H, W)[inner] // 2)) == 3
    expected = ATLAS[seen.face // 2].reshape(H, W, 3) / 255
    assert np.abs(colour[inner] - expected[inner]).max() < 0.02
    facing = (frame.normals * (seen.normal @ T[:3, :3]).reshape(H, W, 3)).sum(axis=2)
    assert facing[inner].min() > 0.999


def test_a_pool_of_every_kind_of_mesh(gl, tmp_path):
    """OBJ, PLY, STL and OFF of one shape are the same objects of a random world, but for their textures."""
    dice(tmp_path)
    plain = trimesh.creation.box((1.6, 1.6, 1.6))
    for kind in ("ply", "stl", "off"):
        plain.export(tmp_path / f"b.{kind}")
    config = PoolConfig(primitives=(), folders=(str(tmp_path),), keep_materials=True, test_fraction=0)
    pool = object_pool(config, tmp_path)
    assert sorted(Path(entry.name).suffix for entry in pool.entries) == [".obj", ".off", ".ply", ".stl"]
    corners = []
    for entry in pool.entries:
        asset = pool.load(entry)
        assert not asset.omissions and not any(part.culled for part in asset.parts)
        corners.append(np.unique(asset.parts[0].mesh.vertices.round(5), axis=0))
        assert asset.has_materials == (entry.name == "d.obj")
    for found in corners:
        np.testing.assert_allclose(found, corners[0], atol=1e-4)
    world = RandomSceneConfig(pool=config, objects={"count": 12}, sky=None, ground=None)
    made = build_scene(world, CameraConfig(width=W, height=H), 0, 10**9, base=tmp_path)
    with Renderer(gl, made, RenderConfig()) as r:
        frame = r.labels(0, LabelRequest("ids"), None, None)
    assert len(np.unique(frame.ids)) > 4
