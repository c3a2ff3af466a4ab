"""Custom scenes: poses, key frames, materials, scales, and bad input by message."""

import json

import numpy as np
import pytest
import trimesh
import yaml
from PIL import Image
from scipy.spatial.transform import Rotation

from blinkgl.config.camera import CameraConfig
from blinkgl.config.poses import PoseConfig
from blinkgl.config.problems import validate
from blinkgl.config.run import load_run
from blinkgl.config.scene import ExplicitSceneConfig
from blinkgl.errors import AssetError, ConfigError
from blinkgl.scene.build import build_scene, check_assets, sequence_scene
from blinkgl.scene.worlds.explicit import pose_matrix
from tests.refusals import refusal
from tests.scene.gltf_files import GltfBuilder

CAMERA = CameraConfig(width=64, height=48)


def build(tmp_path, **tree):
    tree = {
        "kind": "explicit",
        "meshes": {"box": {"primitive": "cuboid"}},
        "objects": [{"mesh": "box"}],
        "camera": {"position": [-3, 0, 1]},
        **tree,
    }
    return build_scene(validate(ExplicitSceneConfig, tree, where="scene"), CAMERA, 0, 10**9, base=tmp_path)


def test_camera_orientations():
    rest = pose_matrix(PoseConfig(), camera=True)[:3, :3]
    np.testing.assert_allclose(rest, np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]))  # z forward = +x, y down = -z
    np.testing.assert_allclose(pose_matrix(PoseConfig(look_at=(5, 0, 0)), camera=True)[:3, :3], rest, atol=1e-12)
    level = pose_matrix(PoseConfig(euler=(-90, 0, -90)), camera=True)[:3, :3]
    np.testing.assert_allclose(level, rest, atol=1e-12)
    np.testing.assert_allclose(
        pose_matrix(PoseConfig(quaternion=(2, 0, 0, 0)), camera=True)[:3, :3], np.eye(3), atol=1e-12
    )


@pytest.mark.parametrize("euler", [(0, 0, 0), (-90, 0, -90), (10, 20, 30), (0, 90, 0), (-45, 10, 170)])
def test_euler_is_the_quaternion_of_the_same_rotation_for_cameras_and_bodies(euler):
    x, y, z, w = Rotation.from_euler("xyz", euler, degrees=True).as_quat()
    for camera in (False, True):
        np.testing.assert_allclose(
            pose_matrix(PoseConfig(euler=euler), camera),
            pose_matrix(PoseConfig(quaternion=(w, x, y, z)), camera),
            atol=1e-12,
        )


def test_a_recipe_that_turns_a_camera_by_euler_is_told_its_former_pose(tmp_path):
    # With the quaternion that the note names the camera looks where version 0.2 turned it: by euler from +x.
    frames = [{"time": 0, "euler": [0, 0, 20]}, {"time": 1, "euler": [0, 9, 20]}]
    scene = build(tmp_path, camera={"keyframes": frames})
    (note,) = [line for line in scene.log if "euler" in line]
    assert note.startswith("scene.camera: euler turns OpenCV's axes (x right, y down, z forward)")
    quaternion = json.loads(note.partition("is quaternion ")[2])
    axes = pose_matrix(PoseConfig(quaternion=quaternion), camera=True)[:3, :3]
    np.testing.assert_allclose(axes[:, 2], [np.cos(np.radians(20)), np.sin(np.radians(20)), 0], atol=1e-6)
    assert build(tmp_path, camera={"look_at": [1, 0, 0]}).log == ()


def test_object_orientations():
    T = pose_matrix(PoseConfig(position=(1, 2, 3), look_at=(1, 7, 3)))
    np.testing.assert_allclose(T, [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-12)
    euler = pose_matrix(PoseConfig(euler=(10, 20, 30)))[:3, :3]
    axes = [Rotation.from_rotvec(np.radians(a) * np.eye(3)[k]).as_matrix() for k, a in enumerate((10, 20, 30))]
    np.testing.assert_allclose(euler, axes[2] @ axes[1] @ axes[0], atol=1e-12)
    q = (0.5, -0.5, 0.1, 0.7)
    np.testing.assert_allclose(
        pose_matrix(PoseConfig(quaternion=q))[:3, :3], Rotation.from_quat([*q[1:], q[0]]).as_matrix(), atol=1e-12
    )
    for target in ((3, -2, 8), (0, 0, 4), (0, 0, -4)):
        R = pose_matrix(PoseConfig(look_at=target))[:3, :3]
        np.testing.assert_allclose(R[:, 0], np.array(target) / np.linalg.norm(target), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1)


def test_keyframes_are_met_and_ends_held(tmp_path):
    frames = [
        {"time": 0.1, "position": [0, 0, 0]},
        {"time": 0.5, "position": [1, 0, 0], "euler": [0, 0, 90]},
        {"time": 0.9, "position": [1, 1, 0], "euler": [0, 0, 180]},
    ]
    scene = build(
        tmp_path,
        objects=[{"mesh": "box", "keyframes": frames}],
        camera={
            "keyframes": [
                {"time": 0, "position": [-3, 0, 1], "look_at": [0, 0, 0]},
                {"time": 1, "position": [0, -3, 1], "look_at": [0, 0, 0]},
            ]
        },
    )
    path = scene.objects[0].path
    for k in frames:
        T = path.pose(round(k["time"] * 1e9))
        np.testing.assert_allclose(
            T, pose_matrix(PoseConfig(**{n: tuple(v) for n, v in k.items() if n != "time"})), atol=1e-9
        )
    np.testing.assert_array_equal(path.pose(0), path.pose(100_000_000))
    np.testing.assert_array_equal(path.pose(10**9), path.pose(900_000_000))
    assert not path.is_static
    for t in (0, 10**9):
        T = scene.camera_path.pose(t)
        to_origin = -T[:3, 3] / np.linalg.norm(T[:3, 3])
        np.testing.assert_allclose(T[:3, 2], to_origin, atol=1e-9)


CRASH = [
    {"mesh": "box", "name": "still", "position": [3, 0, 0]},
    {
        "mesh": "box",
        "name": "moving",
        "interpolation": "linear",
        "keyframes": [{"time": 0, "position": [0, 0, 0]}, {"time": 1, "position": [4, 0, 0]}],
    },
]


def test_collisions_are_found_when_asked_for(tmp_path):
    """Unit cubes 3 apart, one at 4 units/s: their faces meet after 2 units, at 0.5 s."""
    free = build(tmp_path, objects=CRASH)
    assert free.objects[1].path.pose(10**9)[0, 3] == pytest.approx(4) and free.log == ()
    stopped = build(tmp_path, objects=CRASH, collisions=True)
    assert stopped.objects[1].path.pose(10**9)[0, 3] == pytest.approx(2, abs=2e-3)
    assert ("moving" in stopped.log[0] and "t=0.4" in stopped.log[0]) or "t=0.5" in stopped.log[0]


def test_overlapping_bodies_with_collisions_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="scene.collisions: .*at the start"):
        build(tmp_path, objects=[{"mesh": "box", "position": [0.5, 0.1, 0.2]}, CRASH[1]], collisions=True)


def test_materials_meshes_and_scale(tmp_path):
    Image.new("RGB", (40, 20), (255, 0, 0)).save(tmp_path / "red.png")
    trimesh.creation.icosphere(subdivisions=1).export(tmp_path / "ball.stl")
    scene = build(
        tmp_path,
        meshes={
            "box": {"primitive": "cuboid", "parameters": {"extents": [1, 2, 3]}},
            "ball": {"file": "ball.stl"},
            "floor": {"primitive": "grid", "parameters": {"width": 20, "subdivisions": 8}},
        },
        materials={
            "red": {"texture": "red.png", "max_size": 10, "uv_scale": [2, 3], "color": [0.5, 1, 1]},
            "noise": {"procedural": "perlin", "seed": 4, "max_size": 16},
            "screen": {"unlit": True, "both_sides": True},
        },
        objects=[
            {"mesh": "box", "material": "red", "scale": 2},
            {"mesh": "ball", "material": "noise", "scale": [1, 1, 3], "name": "egg"},
            {"mesh": "floor", "material": "screen", "category": "ground"},
            {"mesh": "box"},
        ],
        light={"sun_elevation": 90, "sun": 2},
    )
    box, egg, floor, second = scene.objects
    assert [o.name for o in scene.objects] == ["box", "egg", "floor", "box#3"] and [
        o.instance_id for o in scene.objects
    ] == [1, 2, 3, 4]
    np.testing.assert_allclose(np.ptp(box.parts[0].mesh.vertices, axis=0), [2, 4, 6])
    assert np.ptp(egg.parts[0].mesh.vertices[:, 2]) > 5.5 and not egg.parts[0].culled
    assert (
        box.parts[0].material.texture.image.shape == (5, 10, 3)
        and box.parts[0].material.uv_scale == (2, 3)
        and box.parts[0].material.base_color == (0.5, 1, 1)
    )
    assert egg.parts[0].material.texture.image.shape == (16, 16, 3)
    assert floor.category == "ground" and floor.parts[0].material.unlit and floor.parts[0].material.both_sides
    assert second.parts[0].material.texture is None
    assert scene.light.sun == 2 and scene.light.sun_direction == pytest.approx((0, 0, 1), abs=1e-12)


@pytest.mark.parametrize(
    "suffix, up, expected",
    [
        ("glb", "auto", "y"),
        ("glb", "y", "y"),
        ("glb", "z", "z"),
        ("obj", "auto", "z"),
        ("obj", "z", "z"),
        ("obj", "y", "y"),
    ],
)
def test_which_axis_of_a_file_points_up(tmp_path, suffix, up, expected):
    """The file's (x, y, z) = (1, 2, 3) is drawn there, or at (x, -z, y) when y points up."""
    corners = [[1, 2, 3], [2, 2, 3], [1, 5, 3]]
    if suffix == "glb":
        builder = GltfBuilder()
        builder.node(mesh=builder.mesh(corners, [[0, 1, 2]]))
        builder.write(tmp_path / "a.glb")
    else:
        (tmp_path / "a.obj").write_text("".join("v {} {} {}\n".format(*c) for c in corners) + "f 1 2 3\n")
    scene = build(tmp_path, meshes={"a": {"file": f"a.{suffix}", "up": up}}, objects=[{"mesh": "a"}])
    want = [(x, -z, y) if expected == "y" else (x, y, z) for x, y, z in corners]
    np.testing.assert_allclose(sorted(scene.objects[0].parts[0].mesh.vertices.tolist()), sorted(want), atol=1e-12)
    with pytest.raises(ConfigError, match="up belongs to a file, not to a primitive"):
        build(tmp_path, meshes={"a": {"primitive": "cuboid", "up": "y"}}, objects=[{"mesh": "a"}])


@pytest.mark.parametrize(
    "before, after, step",
    [
        ([0, 0, 0], [0, 0, 40000], "40000 degrees about z"),
        (None, [0, 200, 0], "200 degrees about y"),
        ([-90, 0, 0], [90, 0, 0], "180 degrees about x"),
        ([0, 0, 179], [0, 0, -179], "358 degrees about z"),
    ],
)
def test_a_turn_that_has_no_shortest_way_is_refused(tmp_path, before, after, step):
    keys = [{"time": 0}, {"time": 0.5}, {"time": 1}]
    keys[1] |= {"euler": before} if before else {}
    keys[2] |= {"euler": after}
    assert f"scene.camera: euler changes by {step} from key frame 1 to 2; it must be less than 180" in refusal(
        ConfigError, build, tmp_path, camera={"keyframes": keys}
    )


def test_a_file_keeps_its_own_materials_unless_told_otherwise(tmp_path):
    builder = GltfBuilder()
    builder.tree["materials"] = [{"pbrMetallicRoughness": {"baseColorFactor": [1, 0.5, 0.25, 1]}, "doubleSided": True}]
    builder.node(mesh=builder.mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], uvs=np.zeros((3, 2)), material=0))
    builder.write(tmp_path / "a.glb")
    scene = build(
        tmp_path,
        meshes={"a": {"file": "a.glb"}},
        materials={"checks": {"procedural": "checks", "max_size": 8}},
        objects=[{"mesh": "a"}, {"mesh": "a", "material": "checks"}],
    )
    own, other = (o.parts[0] for o in scene.objects)
    assert own.material.base_color == (1, 0.5, 0.25) and own.material.both_sides
    assert other.material.texture is not None and np.ptp(other.mesh.uvs) > 0.5  # degenerate ones were projected
    assert scene.log == ("a: the texture coordinates are degenerate, projected new ones",)


@pytest.mark.parametrize(
    "tree, expected",
    [
        (
            {"objects": [{"mesh": "bax"}]},
            "scene.objects.0.mesh: no such name under scene.meshes (got 'bax'); expected one of: box",
        ),
        (
            {"objects": [{"mesh": "box", "material": "m"}]},
            "scene.objects.0.material: no such name under scene.materials (got 'm')",
        ),
        (
            {"objects": [{"mesh": "box", "name": "a"}, {"mesh": "box", "name": "a"}]},
            "scene.objects.1.name: two objects have this name (got 'a')",
        ),
        ({"objects": []}, "scene.objects: "),
        (
            {"objects": [{"mesh": "box", "scale": 0}]},
            "scene.objects.0.scale: must be greater than 0 and at most 1e9 (got 0)",
        ),
        (
            {"objects": [{"mesh": "box", "scale": [1, 2]}]},
            "scene.objects.0.scale: must be a number or a list of three (got [1, 2])",
        ),
        (
            {"meshes": {"box": {"primitve": "cuboid"}}},
            "scene.meshes.box.primitve: unknown key; expected 'primitive' (nearest)",
        ),
        (
            {"meshes": {"box": {"file": "gone.obj"}}},
            "scene.meshes.box.file: no such file (got 'gone.obj'); expected a mesh file",
        ),
        ({"meshes": {"box": {}}}, "scene.meshes.box: give exactly one of primitive and file"),
        (
            {"meshes": {"box": {"primitive": "sphere", "parameters": {"radius": -1}}}},
            "scene.meshes.box.parameters.radius: bad parameter (got -1); expected a number greater than 0",
        ),
        (
            {"meshes": {"box": {"primitive": "sphere", "parameters": {"radios": 1}}}},
            "scene.meshes.box.parameters: unknown parameter (got 'radios')",
        ),
        (
            {"materials": {"m": {"texture": "gone.png"}}},
            "scene.materials.m.texture: no such file (got 'gone.png'); expected an image file",
        ),
        (
            {"materials": {"m": {"texture": "a.png", "procedural": "dots"}}},
            "scene.materials.m: only one of texture, procedural, photograph may be given, not texture and procedural",
        ),
        ({"materials": {"m": {"photograph": "lena"}}}, "scene.materials.m.photograph: no such photograph (got 'lena')"),
        (
            {"camera": {"euler": [0, 0, 0], "look_at": [1, 0, 0]}},
            "scene.camera: only one of quaternion, euler, look_at may be given, not euler and look_at",
        ),
        ({"camera": {"quaternion": [0, 0, 0, 0]}}, "scene.camera.quaternion: a quaternion must not be zero"),
        ({"camera": {"keyframes": [{"time": 0}]}}, "scene.camera.keyframes: one key frame is not enough"),
        (
            {"camera": {"keyframes": [{"time": 1}, {"time": 1}]}},
            "scene.camera.keyframes.1.time: the key frames' times must increase",
        ),
        (
            {"camera": {"position": [1, 0, 0], "keyframes": [{"time": 0}, {"time": 1}]}},
            "scene.camera: give a fixed pose or keyframes, not both",
        ),
    ],
)
def test_bad_input(tmp_path, tree, expected):
    assert refusal((ConfigError, AssetError), build, tmp_path, **tree).startswith(expected)


def test_the_sharpest_camera_of_a_rig_decides_the_detail(tmp_path):
    """Of a figure far away a camera with a long lens sees more than the rig's first: it has the vertices that it would
    have for that camera alone."""
    scene = {
        "kind": "explicit",
        "meshes": {"a": {"primitive": "figure"}},
        "objects": [{"mesh": "a", "position": [12, 0, 0]}],
        "camera": {"position": [0, 0, 0]},
    }
    wide, long = {"width": 64, "height": 48, "fov": 70}, {"width": 640, "height": 480, "fov": 5}

    def vertices(**cameras) -> int:
        tree = {"scene": scene, "time": {"duration": 0.2, "label_rate": 10}, **cameras}
        path = tmp_path / "r.yaml"
        path.write_text(yaml.safe_dump(tree))
        return len(sequence_scene(load_run(path).sequence(0), 0).objects[0].parts[0].mesh.vertices)

    alone = {name: vertices(camera=one) for name, one in (("wide", wide), ("long", long))}
    assert alone["wide"] < alone["long"]
    sensors = [{"name": "one", "camera": wide}, {"name": "two", "camera": long}]
    assert vertices(sensors=sensors) == vertices(sensors=sensors[::-1]) == alone["long"]


@pytest.mark.parametrize("kind", ["random", "explicit"])
def test_trajectories_of_lamps_are_looked_for_before_work_starts(tmp_path, kind):
    lights = [{"kind": "point", "motion": {"trajectory": {"file": "gone.txt"}}}]
    world = {"meshes": {"a": {"primitive": "cuboid"}}, "objects": [{"mesh": "a"}], "camera": {}}
    scene = {"kind": kind, "light": {"lights": lights}, **(world if kind == "explicit" else {})}
    path = tmp_path / "r.yaml"
    path.write_text(yaml.safe_dump({"scene": scene}))
    with pytest.raises(
        ConfigError, match=r"scene.light.lights.0.motion.trajectory.file: no such file \(got 'gone.txt'"
    ):
        check_assets(load_run(path).sequence(0).scene, tmp_path)
