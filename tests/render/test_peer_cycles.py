"""A path tracer, Blender's Cycles, draws the same scenes. What is written for it is tested without
it; what it draws, with the extra [cycles]."""

from __future__ import annotations

import json
import os
import stat
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl.blender import process
from blinkgl.blender.inside import trace
from blinkgl.config.sequence import RenderConfig
from blinkgl.errors import BlinkGLError, ConfigError
from blinkgl.render import reference
from blinkgl.render.renderer import Renderer
from blinkgl.scene.lights import lamp_pose
from blinkgl.scene.motion.paths import StaticPath
from blinkgl.scene.types import Lamp, Light, Material, Part, SceneObject
from blinkgl.trade.cycles import Cost, CyclesSettings, blender_camera, colours, export, frames
from render_scenes import LEVEL, cube, mixed_scene, quad, rig, scene, smooth_texture, sphere, still, thing

TIMES = [300_000_000, 650_000_000]
needs_blender = pytest.mark.skipif(bool(process.available()), reason=process.available() or "there")


def exported(world, folder, times=TIMES, settings=CyclesSettings()):
    export(world, times, settings, folder)
    with np.load(folder / "job.npz", allow_pickle=False) as stored:
        return json.loads((folder / "job.json").read_text()), {name: stored[name] for name in stored.files}


def blender_pixel(point: np.ndarray, T_camera: np.ndarray, parameters: dict, width: int, height: int) -> np.ndarray:
    """(2,) our pixel of a world point in Blender's picture, as its manual describes the camera: it looks along -z with
    y up; the sensor of ``sensor_width`` stands at ``lens``, is moved by (shift_x, shift_y) sensor widths, and is
    ``width`` pixels wide; pixels are aspect_y / aspect_x times as high as wide, rows count from the bottom."""
    x, y, z = np.linalg.inv(T_camera)[:3] @ [*point, 1.0]
    pixel = parameters["sensor_width"] / width
    tall = parameters["pixel_aspect_y"] / parameters["pixel_aspect_x"]
    right = parameters["lens"] * x / -z - parameters["shift_x"] * parameters["sensor_width"]
    up = parameters["lens"] * y / -z - parameters["shift_y"] * parameters["sensor_width"]
    return np.array([width / 2 + right / pixel - 0.5, height / 2 - up / (pixel * tall) - 0.5])


@pytest.mark.parametrize("fx, fy, cx, cy", [(150, 150, 79.5, 59.5), (150, 170, 70.0, 66.5), (210, 140, 101.2, 31.0)])
def test_camera_and_poses_mean_the_same_pixel(tmp_path, fx, fy, cx, cy):
    world = mixed_scene()
    eye = replace(world.camera, fx=fx, fy=fy, cx=cx, cy=cy)
    job, arrays = exported(world.with_camera(eye), tmp_path)
    assert job["size"] == [160, 120] and job["blender_camera"] == blender_camera(eye)
    # Blender's least.
    assert min(job["blender_camera"]["pixel_aspect_x"], job["blender_camera"]["pixel_aspect_y"]) == 1.0
    for k, body in enumerate(world.objects):
        for n, t in enumerate(TIMES):
            corner = body.parts[0].mesh.vertices[-1]
            X, Y, Z = (reference.relative_pose_at(world, body, t) @ [*corner, 1.0])[:3]
            there = (arrays["poses"][k, n] @ [*corner, 1.0])[:3]
            found = blender_pixel(there, arrays["camera_poses"][n], job["blender_camera"], 160, 120)
            np.testing.assert_allclose(found, [fx * X / Z + cx, fy * Y / Z + cy], atol=1e-8)


def test_poses_start_from_the_first_camera(tmp_path):
    """Blender takes float32: a scene 1e6 units away would lose its millimetres."""
    _, arrays = exported(mixed_scene(), tmp_path, [*TIMES, TIMES[0]])
    np.testing.assert_array_equal(arrays["camera_poses"][0, :3, 3], 0.0)
    np.testing.assert_array_equal(arrays["poses"][:, 0], arrays["poses"][:, 2])


def test_meshes_materials_and_textures_are_written_once(tmp_path):
    bytes_ = np.random.default_rng(0).integers(0, 256, (6, 8, 3)).astype(np.uint8)
    texture = replace(smooth_texture(), image=bytes_)
    paint = Material(texture, (0.5, 0.6, 0.7), (3.0, 400.0))
    ball = sphere(0.5, 1)
    sky = SceneObject("sky", 1, mixed_scene().objects[0].parts, still(), "sky")
    world = scene(
        [
            sky,
            thing("a", 2, ball, still(), paint),
            thing("b", 3, ball, still((1, 0, 0)), paint),
            thing("c", 4, ball, still(), replace(paint, uv_scale=(1.0, 1.0), double_sided=True, unlit=True)),
        ]
    )
    job, arrays = exported(world, tmp_path)
    assert [b["parts"] for b in job["bodies"]] == [[[0, 0]], [[1, 1]], [[1, 1]], [[2, 2]]]
    assert [b["picture_only"] for b in job["bodies"]] == [True, False, False, False]
    assert [m["texture"] for m in job["materials"]] == [0, 1, 1]
    assert [(m["unlit"], m["culled"]) for m in job["materials"]] == [(True, True), (False, True), (True, False)]
    assert {name for name in arrays if name.startswith("texture")} == {"texture0", "texture1"}
    np.testing.assert_allclose(arrays["texture1"], reference.srgb_to_linear(bytes_ / 255.0), atol=1e-7)
    assert all(
        arrays[f"{name}1"].dtype == dtype
        for name, dtype in (("vertices", np.float32), ("normals", np.float32), ("uvs", np.float32), ("faces", np.int32))
    )
    # v upwards, and the same place in the texture but for whole repeats
    back = arrays["uvs1"] * [1, -1] + [0, 1] - ball.uvs * np.array([3.0, 400.0])
    np.testing.assert_allclose(back, np.rint(back), atol=3e-5)
    assert np.abs(arrays["uvs1"]).max() < 0.6 * 400 and job["light"]["sun"] == Light().sun


def test_rotations_of_the_worker():
    turns = Rotation.concatenate(
        [Rotation.random(50, random_state=1), Rotation.from_rotvec(np.pi * np.eye(3)), Rotation.identity(1)]
    )
    for R in turns.as_matrix():
        again = Rotation.from_quat(trace.quaternion(R), scalar_first=True).as_matrix()
        np.testing.assert_allclose(again, R, atol=1e-14)
        axis = R[:, 2]
        turned = trace.turn_z_to(axis)
        np.testing.assert_allclose(turned[:, 2], axis, atol=1e-14)
        np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(turned) > 0


# ------------------------------------------------------------------------------------------------------- errors


def program(path: Path, text: str) -> str:
    path.write_text(text)
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)


def one_line(error) -> str:
    assert "\n" not in str(error.value)
    return str(error.value)


def test_no_blender_is_one_line_that_says_what_to_do(tmp_path, monkeypatch):
    bare = program(tmp_path / "bare", f"#!/bin/sh\nexec '{sys.executable}' -I -S \"$@\"\n")  # without site-packages
    monkeypatch.setenv(process.ENVIRONMENT, bare)
    with pytest.raises(BlinkGLError) as error:
        next(frames(mixed_scene(), TIMES))
    assert "no bpy" in one_line(error) and "'bpy>=4.5,<4.6'" in str(error.value) and bare in str(error.value)
    monkeypatch.setenv(process.ENVIRONMENT, str(tmp_path / "nothing"))
    with pytest.raises(BlinkGLError, match="names no interpreter that runs"):
        next(frames(mixed_scene(), TIMES))


@pytest.mark.parametrize(
    "module, words",
    [
        (
            "raise ImportError('built for Python 3.11')",
            r"bpy cannot be imported by Python 3\.\d+: built for Python 3.11",
        ),
        (
            "import sys; print('Segmentation of something'); sys.exit(11)",
            r"stopped \(status 11\) after 0 of 2 frames: Segmentation of something",
        ),
        ("", r"stopped \(status 1\) after 0 of 2 frames: AttributeError"),
    ],
)
def test_blender_that_does_not_fit_or_stops_is_one_line(tmp_path, monkeypatch, module, words):
    (tmp_path / "bpy.py").write_text(module + "\n")
    monkeypatch.setenv(
        process.ENVIRONMENT,
        program(tmp_path / "python", f"#!/bin/sh\nPYTHONPATH='{tmp_path}' exec '{sys.executable}' \"$@\"\n"),
    )
    assert process.available() == ""
    with pytest.raises(BlinkGLError, match=words) as error:
        next(frames(mixed_scene(), TIMES))
    one_line(error)


def test_abandoned_frames_end_the_process(tmp_path, monkeypatch):
    fake = f"""#!{sys.executable}
import os, sys, time
if sys.argv[1] == "-c": sys.exit(0)
import numpy as np
folder = sys.argv[2]
np.save(folder + "/000000.npy", np.full((2, 3, 3), 0.5, np.float32))
open({str(tmp_path / "who")!r}, "w").write(f"{{os.getpid()}} {{folder}}")
print('{{"blender": "none", "setup_s": 1, "setup_cpu_s": 1}}', flush=True)
print('{{"frame": 0, "wall_s": 2, "cpu_s": 3}}', flush=True)
time.sleep(600)
"""
    monkeypatch.setenv(process.ENVIRONMENT, program(tmp_path / "python", fake))
    cost = Cost()
    pictures = frames(mixed_scene(), TIMES, cost=cost)
    first = next(pictures)
    assert (
        first.dtype == np.float32
        and np.allclose(first, 0.5)
        and (cost.wall_s, cost.cpu_s, cost.setup_s) == ([2], [3], 1)
    )
    pid, folder = (tmp_path / "who").read_text().split()
    pictures.close()
    assert not Path(folder).exists()
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid), 0)


@pytest.mark.parametrize(
    "wrong, words",
    [
        ({"samples": 0}, "cycles.samples: out of range"),
        ({"bounces": -1}, "cycles.bounces"),
        ({"shadows": False}, "cycles.bounces: light that passes through"),
    ],
)
def test_settings_are_checked(wrong, words):
    with pytest.raises(ConfigError, match=words):
        CyclesSettings(**wrong)


# -------------------------------------------------------------------------------------------- with Blender, [cycles]


def ours(gl, world, t):
    with Renderer(gl, world, RenderConfig(antialiasing="ssaa4")) as renderer:
        return renderer.luminance(t).read()


def band_of(world, t):
    true = reference.render(world, t)
    return reference.silhouette_band(true.instance, true.depth), true


@needs_blender
def test_unlit_pictures_agree(gl):
    """Geometry, texture coordinates, poses and camera at once: band-limited textures, a
    principal point off the middle, fx != fy.

    Inside, both take the mean of the same smooth function over the pixel (16 samples each); what differs is our mip
    map, a box over up to two texels. A shift of a tenth of a pixel would show as 8e-4 at the median; with 256 paths the
    median falls to 1e-5. At silhouettes both have 16 samples: 1/16 of a contrast below 0.7 is 0.04 each."""
    world = mixed_scene(unlit=True)
    cost = Cost()
    for t, theirs in zip(TIMES, frames(world, TIMES, CyclesSettings(samples=16, shadows=False, bounces=0), cost)):
        mine = ours(gl, world, t)
        band, _ = band_of(world, t)
        error = np.abs(theirs - mine)
        assert np.median(error) < 3e-4 and np.quantile(error[~band], 0.99) < 2e-3
        assert error.max() < 0.1 and np.abs((theirs - mine).mean()) < 1e-4
    assert len(cost.wall_s) == 2 and min(cost.cpu_s) > 0 and cost.blender.startswith("Blender")


@needs_blender
@pytest.mark.parametrize("sun, sky", [(1.2, 0.0), (0.0, 1.0)])
def test_light_without_shadows_is_ours(gl, sun, sky):
    """Shading normals (smooth and flat, two-sided from behind), the sun's direction, pi in its lamp, the sky's formula.
    What is left at the 99th percentile is the mip map, as above; the sun has a few triangles more, where it grazes: a
    normal interpolated there points away from its triangle, which a path tracer does not light."""
    world = replace(mixed_scene(), light=Light(sun=sun, sky=sky))
    theirs = next(frames(world, TIMES[:1], CyclesSettings(samples=16, shadows=False, bounces=0)))
    band, true = band_of(world, TIMES[0])
    error = np.abs(theirs - ours(gl, world, TIMES[0]))
    for instance in (2, 3, 4, 5):
        here = (true.instance == instance) & ~band
        assert here.sum() > 300 and np.median(error[here]) < 6e-4 and np.quantile(error[here], 0.95) < 2.5e-3
        assert sun or np.quantile(error[here], 0.99) < 2.5e-3
    # Something of it is lit.
    assert max((true.luminance[(true.instance == k) & ~band] > 0.1).sum() for k in (3, 4, 5)) > 200


@needs_blender
@pytest.mark.parametrize("kind", ["sun", "point", "spot"])
def test_a_lamp_shines_as_it_does_there(gl, kind):
    """Each alone, of a colour, at path depth 1 without shadows: strength, place, direction and cone."""
    pose = lamp_pose((0.4, 3.0, 2.0), (-0.1, 0.4, -1.0))
    strength, angle = ((0.9, 0.6, 0.3) if kind == "sun" else (9.0, 6.0, 3.0)), 0.6
    lamp = Lamp(kind, strength, StaticPath(pose), inner=angle * (1 - 1e-6), outer=angle)
    world = replace(mixed_scene(textured=False), light=Light(sun=0.0, sky=0.0, lamps=(lamp,)))
    (theirs,) = colours(world, TIMES[:1], CyclesSettings(samples=16, shadows=False, bounces=0))
    band, true = band_of(world, TIMES[0])
    with Renderer(gl, world, RenderConfig(image_antialiasing="ssaa4")) as renderer:
        mine = renderer.colour(TIMES[0]).read()
    lit = (true.colour.min(axis=-1) > 0.02) & ~band & (true.instance > 1)
    error = np.abs(theirs / mine - 1)[lit]
    assert lit.sum() > 1000 and np.median(error) < 0.002 and np.quantile(error, 0.9) < 0.01


@needs_blender
def test_shadow_of_a_ball_lies_where_it_should():
    """Sun alone on a plane: dark exactly where the line from the ground to the sun meets the ball."""
    radius, centre, sun = 0.5, np.array([0.2, 4.0, 0.6]), np.array([-0.5, -0.3, 1.0]) / np.sqrt(1.34)
    paint = Material(base_color=(0.5, 0.5, 0.5))
    world = scene(
        [
            SceneObject("ground", 1, (Part(quad(15, 15), paint),), still((0, 5, -1)), "ground"),
            thing("ball", 2, sphere(radius, 4), still(centre), paint),
        ],
        rig(path=still((0, 0, 1.0), LEVEL * Rotation.from_rotvec([-0.4, 0, 0]))),
        Light(tuple(sun), 1.0, 0.0),
    )
    theirs = next(frames(world, [0], CyclesSettings(samples=16, bounces=0)))
    true = reference.render(world, 0)
    ground = true.instance == 1
    point = true.local[ground] + [0, 5, -1] - centre
    distance = np.linalg.norm(np.cross(point, sun), axis=1)
    dark, light = np.zeros(ground.shape, bool), np.zeros(ground.shape, bool)
    dark[ground], light[ground] = distance < radius, distance > radius
    edge = reference.silhouette_band(2 * true.instance + dark, true.depth)  # of the ball and of its shadow, one pixel
    assert (dark & ~edge).sum() > 150
    np.testing.assert_allclose(theirs[dark & ~edge], 0.0, atol=1e-6)
    np.testing.assert_allclose(theirs[light & ~edge], 0.5 * sun[2], rtol=1e-5)


@needs_blender
def test_ground_shines_on_a_sheet():
    """Inter-reflection has a closed form over a wide ground: a vertical sheet gets half of the dome and, of the
    ground's radiance albedo * sky, half again: L = a_sheet sky (0.5 + 0.5 a_ground)."""

    def paint(albedo, **more):
        return Material(base_color=(albedo,) * 3, **more)

    world = scene(
        [
            SceneObject("ground", 1, (Part(quad(4000, 4000), paint(0.6)),), still((0, 0, -20)), "ground"),
            thing("sheet", 2, quad(1, 1), still((0, 3, 0), LEVEL), paint(0.5, double_sided=True)),
        ],
        rig(48, 32, 60.0),
        Light(sun=0.0, sky=0.8),
    )
    sheet = reference.render(world, 0).instance == 2
    assert sheet.sum() > 500
    for bounces, factor in ((0, 0.5), (1, 0.8)):
        theirs = next(frames(world, [0], CyclesSettings(samples=64, bounces=bounces)))
        assert theirs[sheet].mean() == pytest.approx(0.5 * 0.8 * factor, rel=0.01)


@needs_blender
def test_one_sided_meshes_vanish_from_behind_and_the_same_seed_draws_the_same(tmp_path):
    """The camera stands in a closed cube, which BlinkGL culls, and sees the sheet outside; a
    still scene is the same in every frame."""
    world = scene(
        [
            thing("around", 1, cube(0.5), still(), Material(base_color=(1, 0, 0), unlit=True)),
            thing(
                "sheet",
                2,
                quad(9, 9),
                still((0, 3, 0), LEVEL),
                Material(base_color=(0.25,) * 3, unlit=True, double_sided=True),
            ),
        ],
        rig(32, 24, 30.0),
    )
    pictures = list(colours(world, [0, 1000], CyclesSettings(samples=4)))
    np.testing.assert_allclose(pictures[0], 0.25, atol=1e-6)
    np.testing.assert_array_equal(*pictures)
