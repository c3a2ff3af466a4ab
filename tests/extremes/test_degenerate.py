"""Triangles without width, by themselves or as they are seen: no NaN, no infinity, no pixel that they do not have."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl import Camera, Keyframes, Light as Sun, Pose, Primitive, Scene as BlinkScene, record
from blinkgl.camera import PinHole
from blinkgl.config.run import RunTemplate
from blinkgl.config.sequence import RenderConfig
from blinkgl.dataset.generate import generate_sequence
from blinkgl.errors import AssetError, EventDataError
from blinkgl.labels import LABELS, LabelRequest
from blinkgl.render import renderer as module
from blinkgl.render.passes import Geometry
from blinkgl.render.renderer import Renderer
from blinkgl.scene.geometry import primitives
from blinkgl.scene.geometry.meshes import faces_in_float32
from blinkgl.scene.rig import Rig
from blinkgl.scene.types import Light, Material, Part, SceneObject, Texture
from blinkgl.sequence_files.sequence_dir import verify_sequence
from tests.render.render_scenes import FACING, LEVEL, cube, drift, mesh, quad, rig, scene, smooth_texture, still, thing
from tests.shared_data import shared

MS = 1_000_000
RAW = Geometry(tuple(name for name, label in LABELS.items() if label.buffer))


def sheet(corners: np.ndarray, seed: int = 1):
    """A mesh of (n, 3, 3) separate triangles with random texture coordinates."""
    vertices = corners.reshape(-1, 3)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 0, normals / np.where(length > 0, length, 1.0), (0.0, 0.0, 1.0))
    uvs = np.random.default_rng(seed).uniform(0, 1, (len(vertices), 2))
    return mesh(vertices, np.arange(len(vertices)).reshape(-1, 3), np.repeat(normals, 3, axis=0), uvs)


def directions(rng, n: int) -> np.ndarray:
    d = rng.normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def slivers(rng, n: int, ahead=(1.5, 5.0)) -> np.ndarray:
    """(n, 3, 3) before a LEVEL camera at the origin, of relative height 1e-12 to 1e-3 in any direction."""
    along, length = directions(rng, n), 10 ** rng.uniform(-2, 0.5, (n, 1))
    up = np.cross(along, directions(rng, n))
    up *= 10 ** rng.uniform(-12, -3, (n, 1)) * length / np.linalg.norm(up, axis=1, keepdims=True)
    middle = np.stack([rng.uniform(-1.2, 1.2, n), rng.uniform(*ahead, n), rng.uniform(-1, 1, n)], axis=1)
    start, end = middle - along * length / 2, middle + along * length / 2
    return np.stack([start, end, start + rng.uniform(0, 1, (n, 1)) * (end - start) + up], axis=1)


def edge_on(rng, n: int) -> np.ndarray:
    """(n, 3, 3) of any shape in planes through the camera's centre, the origin."""
    corners = slivers(rng, n)
    a, b = corners[:, 0], corners[:, 1]
    return np.stack([a, b, rng.uniform(0.3, 1.2, (n, 1)) * a + rng.uniform(0.0, 0.6, (n, 1)) * b], axis=1)


def nasty() -> np.ndarray:
    """Every kind at once: points, lines, needles, triangles across and in the camera plane and
    the near plane, of 1e-6 to 1e6 units."""
    rng = np.random.default_rng(3)
    line = np.array([[-1.0, 2, 0.1], [1.0, 3, 0.2], [0.0, 2.5, 0.15]])
    needle = np.array([[-1.0, 2, 0.3], [1.0, 2, 0.3], [0.2, 2, 0.3 + 1e-7]])
    through = np.array([[-1.0, -2, -0.5], [1.0, 3, -0.5], [0.5, 4, 0.5]])
    in_plane = np.array([[-1.0, 0, -0.5], [1.0, 0, -0.5], [0.0, 0, 0.5]])
    at_near = np.array([[-1.0, 0.05, -0.5], [1.0, 0.05, -0.5], [0.0, 0.05, 0.5]])
    # Exactly edge-on where the principal point lies on x = 0.
    upright = np.array([[0.0, 2, -0.5], [0.0, 4, -0.5], [0.0, 3, 0.5]])
    point = np.full((3, 3), 2.0)
    shapes = [
        line,
        needle,
        through,
        in_plane,
        at_near,
        upright,
        point,
        line[[0, 1, 1]],
        1e6 * line,
        1e-6 * line + (0, 2, 0),
        1e6 * needle,
        1e-4 * through,
    ]
    return np.concatenate([np.stack(shapes), slivers(rng, 300), slivers(rng, 300, (-0.5, 0.5)), edge_on(rng, 300)])


def raw_buffers(renderer) -> dict[str, np.ndarray]:
    """Everything that every pass writes at 0, as it leaves the fragment shaders."""
    buffers = renderer.draw(RAW, 0, {"forward": 100 * MS, "backward": -100 * MS})
    return {
        **{name: buffers.read(name) for name in buffers.names},
        "luminance": renderer.luminance(0).read(),
        "with rate": renderer.brightness(0).read(),
        "colour": renderer.colour(0).read(),
        "brightness": renderer.brightness(0, 3).read(),
        "motion": renderer.velocity(0, 3).read(),
    }


@pytest.mark.parametrize("antialiasing", ["none", "taps4", "edges", "ssaa2"])
@pytest.mark.parametrize("textured", [True, False])
@pytest.mark.parametrize("lines_drawn", [True, False])
def test_every_pass_of_a_nasty_mesh_is_finite(gl, monkeypatch, antialiasing, textured, lines_drawn):
    """The shaders do not rest on the lines' being dropped before."""
    if lines_drawn:
        monkeypatch.setattr(module, "without_collapsed_faces", lambda scene: scene)
    corners = nasty()
    world = []
    for lit in (True, False):
        for both_sides in (True, False):
            paint = Material(texture=smooth_texture(1) if textured else None, unlit=not lit, both_sides=both_sides)
            whole = replace(sheet(corners), closed=not both_sides)  # closed: culled, not two-sided
            world.append(
                scene(
                    [thing("nasty", 1, whole, drift((0, 0, 0), (0.1, 0.05, -0.3)), paint)],
                    rig(80, 60, 75.0, still(rotation=LEVEL)),
                )
            )
    world.append(
        replace(
            world[0],
            rig=rig(81, 61, 64.0, drift((0, 0, 0), (0.1, 0.2, 0), LEVEL, LEVEL * Rotation.from_rotvec([0.1, 0, 0]))),
        )
    )
    for one in world:
        with Renderer(gl, one, RenderConfig(antialiasing=antialiasing, image_antialiasing="none")) as renderer:
            for name, buffer in raw_buffers(renderer).items():
                assert np.isfinite(buffer).all(), name


@pytest.mark.parametrize("seed", range(4))
def test_slivers_have_the_depth_and_the_light_of_what_they_are(gl, seed):
    corners = slivers(np.random.default_rng(seed), 1000)
    world = scene(
        [
            thing(
                "slivers", 1, sheet(corners), drift((0, 0, 0), (0.02, 0.01, 0.03)), Material(texture=smooth_texture(1))
            )
        ],
        rig(near=0.01),
    )
    with Renderer(gl, world, RenderConfig(image_antialiasing="none")) as renderer:
        buffers = raw_buffers(renderer)
    hit = buffers["ids"] > 0
    assert 10 < hit.sum() < 300 and all(np.isfinite(b).all() for b in buffers.values())
    depth, reach = buffers["depth"][hit], corners[..., 1]
    assert depth.min() > 0.99 * reach.min() and depth.max() < 1.01 * reach.max()
    np.testing.assert_array_equal(buffers["luminance"] > 0, hit)
    assert buffers["luminance"].max() < 0.85 * (world.light.sun + world.light.sky)
    np.testing.assert_allclose(np.linalg.norm(buffers["normals"][hit], axis=-1), 1, atol=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_what_is_seen_from_its_edge_is_not_seen(gl, seed):
    """Snapped corners cover pixels; before there was a guard a third of 60 such pixels were NaN
    and most others at no depth of the mesh."""
    world = scene([thing("edges", 1, sheet(edge_on(np.random.default_rng(seed), 3000)), still())], rig(near=0.01))
    with Renderer(gl, world, RenderConfig()) as renderer:
        assert not renderer.labels(0, LabelRequest("ids")).ids.any() and not renderer.luminance(0).read().any()


@pytest.mark.parametrize("unlit", [True, False])
@pytest.mark.parametrize("antialiasing", ["none", "taps4", "edges"])
def test_a_neighbour_on_the_horizon_has_no_texture_coordinates(gl, antialiasing, unlit):
    """A ground that ends half a pixel below the horizon: in powers of two 1/w is exactly 0 in the row above its last,
    and derivatives of texture coordinates and normals between those rows are infinite."""
    vertices = np.array([[-128, 128, -1], [128, 128, -1], [-1, 1, -1]], float)
    ground = mesh(vertices, [[2, 1, 0]], np.tile([0, 0, 1.0], (3, 1)), vertices[:, :2] / 4)
    eye = Rig.alone(PinHole(128, 128, 64.0, 64.0, 64.0, 32.0, near=0.25), drift((0, 0, 0), (0, 0.1, 0), LEVEL))
    paint = smooth_texture(1)
    with Renderer(
        gl,
        scene(
            [thing("ground", 1, ground, still(), Material(texture=paint, unlit=unlit))], eye, Light(sun=0.0, sky=1.0)
        ),
        RenderConfig(antialiasing=antialiasing),
    ) as renderer:
        buffers = raw_buffers(renderer)
    last = buffers["ids"][33] > 0
    assert last.sum() > 100 and not buffers["ids"][:33].any()
    ends = np.flatnonzero(last)[[0, -1]]
    if antialiasing == "edges":
        last[ends] = False  # it ends there, in the middle of the first pixel: what is behind is in them, too
    for name, buffer in buffers.items():
        assert np.isfinite(buffer).all(), name
    mean = paint.image.mean(axis=(0, 1)) @ (0.2126, 0.7152, 0.0722)
    np.testing.assert_allclose(buffers["luminance"][33][last], mean, rtol=1e-4)  # thousands of repeats in a pixel
    share = buffers["luminance"][33][ends] / mean
    assert ((share > 0.4) & (share < 1.0001)).all()


# ---- which faces are lines ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1e-12, 1e-3, 1.0, 1e9])
@pytest.mark.parametrize("offset", [0.0, 30.0])
def test_lines_are_dropped_and_slivers_are_not(size, offset):
    """Collinear in float64, and so in nothing that float32 makes of it; and slivers a few
    roundings high, far thinner than any model has."""
    rng = np.random.default_rng(0)
    corners = slivers(rng, 4000)
    a, b = corners[:, 0] + offset, corners[:, 1] + offset
    lines = np.stack([a, b, a + rng.uniform(0, 1, (len(a), 1)) * (b - a)], axis=1)
    assert not faces_in_float32(sheet(size * lines)).any()
    up = np.cross(b - a, directions(rng, len(a)))
    up *= 8e-7 * np.abs(lines).max(axis=(1, 2))[:, None] / np.linalg.norm(up, axis=1, keepdims=True)
    lines[:, 2] += up
    assert faces_in_float32(sheet(size * lines)).all()


def test_the_renderer_drops_lines_and_says_so(gl):
    ball = primitives.icosphere(subdivisions=4)
    a, b = ball.vertices[ball.faces[0, :2]]
    vertices = np.concatenate([ball.vertices, [(a + b) / 2]])
    faces = np.concatenate([ball.faces, [[ball.faces[0, 0], ball.faces[0, 1], len(ball.vertices)]]]).astype(np.int32)
    split = replace(
        ball,
        vertices=vertices,
        faces=faces,
        normals=np.concatenate([ball.normals, ball.normals[:1]]),
        uvs=np.concatenate([ball.uvs, ball.uvs[:1]]),
    )
    line = sheet(slivers(np.random.default_rng(0), 1) * 0 + np.array([[0, 0, 0], [1, 1, 1], [2, 2, 2.0]]))
    two = SceneObject("ball", 1, (Part(line, Material()), Part(split, Material())), still((0, 4, 0)))
    world = scene([two, thing("other", 2, split, still((1, 5, 0)))])
    with Renderer(gl, world, RenderConfig()) as renderer:
        assert [len(o.parts) for o in renderer.scene.objects] == [1, 1]
        assert renderer.scene.objects[0].parts[0].mesh is renderer.scene.objects[1].parts[0].mesh
        assert all(faces_in_float32(p.mesh).all() for o in renderer.scene.objects for p in o.parts)
        said = renderer.scene.log[-1]
        assert "without width in float32" in said and said.startswith("3 triangles")
        assert set(np.unique(renderer.labels(0, LabelRequest("ids")).ids)) == {0, 1, 2}
    with Renderer(gl, scene([thing("ball", 1, ball, still((0, 4, 0)))]), RenderConfig()) as renderer:
        assert not renderer.scene.log


# ---- numbers that are none ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1e-3, 1e30])
def test_a_texture_with_a_number_that_is_none_is_refused(gl, bad):
    image = np.full((8, 8, 3), 0.5, np.float32)
    image[2, 5] = bad
    world = scene([thing("wall", 1, quad(), still((0, 3, 0), FACING), Material(texture=Texture(image, "poster")))])
    for draw in (lambda r: r.luminance(0).read(), lambda r: r.colour(0).read()):
        with (
            Renderer(gl, world, RenderConfig()) as renderer,
            pytest.raises(AssetError, match=r"^poster: texel x=5, y=2 cannot be drawn .*linear light from 0"),
        ):
            draw(renderer)


def test_a_mesh_with_a_number_that_is_none_is_refused(gl):
    plain = quad()
    for name in ("normals", "uvs"):
        values = getattr(plain, name).copy()
        values[2, 0] = np.nan
        world = scene([thing("wall", 1, replace(plain, **{name: values}), still((0, 3, 0), FACING))])
        with (
            Renderer(gl, world, RenderConfig()) as renderer,
            pytest.raises(AssetError, match="^quad: vertex 2 has a .* finite numbers$"),
        ):
            renderer.luminance(0).read()


@pytest.mark.parametrize(
    "color, background, seen",
    [
        ((np.nan, 1.0, 1.0), 0.0, r"object 'wall' \(id 7\)"),
        ((-1.0, -1.0, -1.0), 0.0, r"object 'wall' \(id 7\)"),
        ((0.5, 0.5, 0.5), np.inf, "the background"),
    ],
)
def test_the_message_names_what_is_seen_where_and_when(gl, color, background, seen):
    from blinkgl.config.events import EsimConfig
    from blinkgl.config.sequence import SequenceConfig
    from blinkgl.config.timeline import UniformTimeline
    from blinkgl.sequence import SequenceRequest, simulate_sequence

    wall = thing("wall", 7, quad(0.5, 0.5), still((0, 3, 0), FACING), Material(base_color=color, unlit=True))
    world = replace(scene([wall], background=background), t0_ns=250 * MS, t1_ns=500 * MS)
    with Renderer(gl, world, RenderConfig()) as renderer:
        with pytest.raises(
            EventDataError,
            match=rf"^frame 0 at 0\.25 s: intensity at pixel x=\d+, y=\d+ cannot be used: it shows {seen} \(got .*\); "
            r"expected a finite value",
        ) as caught:
            list(
                simulate_sequence(
                    SequenceRequest(
                        SequenceConfig(timeline=UniformTimeline(fps=100), events=EsimConfig()),
                        labels=False,
                        renderer=renderer,
                    )
                )
            )
    assert "\n" not in str(caught.value)
    x, y = caught.value.pixel
    assert (abs(x - 78) < 27 and abs(y - 60) < 27) == (background == 0.0)


def test_models_keep_their_faces():
    for shape in (
        primitives.cuboid(),
        primitives.sphere(),
        primitives.torus(),
        primitives.icosphere(subdivisions=5),
        quad(1e5, 1e5, 32),
        cube(1e-6),
    ):
        assert faces_in_float32(shape).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed, count", [(7, 40), (11, 81), (12, 81), (13, 81), (14, 81)])
def test_a_sequence_of_81_small_models(gl, tmp_path, seed, count):
    """640x480, 200 frames and every label, of 81 files, in some of which faces are lines: the
    first was lost to one NaN pixel in frame 117."""
    folder = shared("data/assets/models_cc0")
    tree = {
        "seed": seed,
        "camera": {"width": 640, "height": 480},
        "time": {"duration": 0.5, "label_rate": 10},
        "timeline": {"kind": "uniform", "fps": 199 / 0.6},
        "scene": {
            "kind": "random",
            "objects": {"count": count},
            "pool": {"primitives": [], "folders": [str(folder)], "keep_materials": True, "test_fraction": 0},
        },
        "labels": {
            "flow": ["forward", "backward"],
            "depth": True,
            "ids": True,
            "normals": True,
            "velocity": True,
            "occlusion": True,
        },
        "preview": {"enabled": False},
    }
    report = generate_sequence(RunTemplate(tree, Path(".")).sequence(0), 0, tmp_path, gl)
    assert report.frames == 200 and verify_sequence(report.path) == []
    for k in range(report.labels):
        depth, normals, velocity = (
            np.load(report.path / f"{name}/{k:06d}.npy") for name in ("depth", "normals", "velocity")
        )
        assert np.isfinite(depth).mean() > 0.9 and np.isfinite(normals).all() and np.isfinite(velocity).all()


@pytest.mark.parametrize("antialiasing", ["none", "edges", "edges2", "ssaa4"])
@pytest.mark.parametrize("normal", [(1, 0, 0), (0, 0, 1)], ids=["upright", "level"])
def test_a_plate_seen_exactly_edge_on_changes_no_pixel(gl, antialiasing, normal):
    """A plane through the camera's centre has no area in the picture, whatever its lines are."""
    turned = Rotation.align_vectors([normal], [[0, 0, 1]])[0].as_matrix()
    plate = mesh(quad(0.5, 0.5).vertices @ turned.T, quad().faces, np.tile(np.float64(normal), (4, 1)), quad().uvs)
    glowing = Material(base_color=(0, 0, 0), emission=(3.0, 3.0, 3.0), both_sides=True)
    wall = SceneObject("wall", 1, (Part(quad(9, 9), Material(emission=(0.5, 0.5, 0.5))),), still((0, 9, 0), LEVEL))
    there = SceneObject("plate", 2, (Part(plate, glowing),), still((0, 3, 0)))
    pictures = []
    for bodies in ([wall], [wall, there]):
        with Renderer(gl, scene(bodies, rig()), RenderConfig(antialiasing=antialiasing)) as renderer:
            pictures.append(renderer.luminance(0).read().copy())
    assert pictures[0].min() > 0.4 and np.abs(pictures[1] - pictures[0]).max() < 1e-6


def test_without_light_a_moving_picture_is_black_and_makes_no_event():
    camera = Camera(32, 24, pose=Keyframes({0.0: Pose((-3, 0, 0)), 0.1: Pose((-3, 1, 0))}))
    dark = BlinkScene(camera, light=Sun(0, 0), background=0.0, duration=0.1) + Primitive("cuboid")
    made = record(dark, emulator={"emulator": "esim"}, labels=["images"])
    assert len(made.events) == 0 and len(made.images) and not np.any(made.images)
