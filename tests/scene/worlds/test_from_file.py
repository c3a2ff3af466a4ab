"""glTF scenes against hand-made ones and against trimesh's own reader."""

import math

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from blinkgl.config.camera import CameraConfig
from blinkgl.config.problems import validate
from blinkgl.config.scene import FileSceneConfig
from blinkgl.errors import AssetError, ConfigError
from blinkgl.scene.build import build_scene
from blinkgl.scene.importing import gltf
from blinkgl.scene.importing.mesh_files import load_asset
from blinkgl.scene.importing.parts import Z_UP, transformed
from blinkgl.scene.worlds.from_file import from_document, split_rigid
from tests.refusals import refusal
from tests.scene.faces import outwards, points_at, vectors, volume
from tests.scene.gltf_files import GltfBuilder, arm_file, triangle, triangle_file
from tests.shared_data import shared

SETTINGS = CameraConfig(width=64, height=48, fov=70)
CAMERA = SETTINGS.model
T1 = 10**9
HALF = math.sqrt(0.5)
BOX = trimesh.creation.box(extents=(1, 2, 3))


def with_camera(builder: GltfBuilder, **node) -> GltfBuilder:
    builder.tree["cameras"] = [{"type": "perspective", "name": "main", "perspective": {"yfov": 0.8, "znear": 0.02}}]
    builder.node(camera=0, name="eye", **node)
    return builder


def load(tmp_path, builder, **options):
    return from_document(gltf.read(builder.write(tmp_path / "scene.glb")), CAMERA, 0, T1, **options)


def bounds(points):
    return np.stack([points.min(axis=0), points.max(axis=0)])


def test_split_rigid():
    rng = np.random.default_rng(0)
    for _ in range(50):
        M = np.eye(4)
        M[:3] = rng.normal(size=(3, 4))
        T, A = split_rigid(M)
        np.testing.assert_allclose(T @ A, M, atol=1e-12)
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1) and np.sign(np.linalg.det(A)) == np.sign(
            np.linalg.det(M[:3, :3])
        )
    T, A = split_rigid(np.diag([2.0, 3, 4, 1]))
    np.testing.assert_allclose(T, np.eye(4), atol=1e-15)


def test_the_hierarchy_is_composed_and_scale_is_baked(tmp_path):
    builder = with_camera(GltfBuilder())
    box = builder.mesh(BOX.vertices, BOX.faces)
    quarter = [0, math.sin(math.pi / 4), 0, math.cos(math.pi / 4)]  # 90 degrees about the file's y
    child = builder.node(root=False, mesh=box, name="child", translation=[1, 0, 0], scale=[2, 1, 1])
    builder.node(name="parent", translation=[0, 5, 0], rotation=quarter, scale=[3, 3, 3], children=[child])
    scene = load(tmp_path, builder)
    (o,) = scene.objects
    assert o.name == "child" and o.instance_id == 1 and o.parts[0].culled
    # file: box 2x2x3 scaled by 3 -> 6x6x9 about (3, 0, 0), x -> -z, then +5 y; world: (x, y, z) -> (x, -z, y)
    np.testing.assert_allclose(bounds(points_at(o)), [[-4.5, 0, 2], [4.5, 6, 8]], atol=1e-6)
    assert volume(o.parts[0].mesh) == pytest.approx(6 * 2 * 27, rel=1e-6)
    T = o.path.pose(0)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)


def test_the_camera_sees_what_gltf_says(tmp_path):
    """glTF: at (0, 0, 10) looking along -z, y up. A point to its right and up must be right and up in the image."""
    builder = triangle_file(with_camera(GltfBuilder(), translation=[0, 0, 10], scale=[2, 2, 2]))
    scene = load(tmp_path, builder, intrinsics="file")
    T = scene.camera_path.pose(0)
    X = np.linalg.inv(T) @ Z_UP @ [1, 2, 0, 1]
    np.testing.assert_allclose(X[:3], [1, -2, 10], atol=1e-12)
    assert scene.camera.fy == pytest.approx(24 / math.tan(0.4)) and scene.camera.fx == scene.camera.fy
    assert (scene.camera.cx, scene.camera.cy, scene.camera.near) == (31.5, 23.5, 0.02)
    # the top of the picture (y = -0.5) is at half the field of view
    assert math.atan((scene.camera.cy + 0.5) / scene.camera.fy) == pytest.approx(0.4)
    assert load(tmp_path, builder).camera.fx == pytest.approx(CAMERA.fx)


def test_materials(tmp_path):
    builder = with_camera(GltfBuilder())
    pixels = np.zeros((2, 4, 3), np.uint8)
    pixels[0, 0] = (255, 128, 0)
    Image.fromarray(pixels).save(tmp_path / "t.png")
    builder.tree["images"] = [
        {"bufferView": builder.view((tmp_path / "t.png").read_bytes()), "mimeType": "image/png", "name": "pic"}
    ]
    builder.tree["textures"] = [{"source": 0}]
    transform = {"KHR_texture_transform": {"offset": [0.25, 0.5], "scale": [2, 4]}}
    builder.tree["materials"] = [
        {
            "pbrMetallicRoughness": {"baseColorFactor": [0.5, 0.25, 1, 0.5], "baseColorTexture": {"index": 0}},
            "doubleSided": True,
        },
        {
            "extensions": {"KHR_materials_unlit": {}},
            "pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "extensions": transform}},
        },
    ]
    uvs = [[0, 0], [1, 0], [0, 1]]
    for m in (0, 1):
        builder.node(mesh=triangle(builder, uvs=uvs, material=m))
    builder.node(mesh=triangle(builder))
    first, second, third = (o.parts[0] for o in load(tmp_path, builder).objects)
    assert first.material.base_color == (0.5, 0.25, 1) and first.material.both_sides and not first.material.unlit
    np.testing.assert_array_equal(first.material.texture.image, pixels)
    assert second.material.unlit and second.material.texture is first.material.texture
    # uv (0, 0) is the image's first pixel, top left, and v grows downwards: as in the file
    for part, expected in ((first, np.array(uvs)), (second, np.array(uvs) * [2, 4] + [0.25, 0.5])):
        order = np.lexsort(part.mesh.vertices.T)
        want = np.lexsort(Z_UP[:3, :3] @ np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float).T)
        np.testing.assert_allclose(part.mesh.uvs[order], expected[want], atol=1e-6)
    assert third.material.texture is None and third.material.base_color == (1, 1, 1)


def test_interleaved_buffers_and_what_is_no_triangle(tmp_path):
    builder = with_camera(GltfBuilder())
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "f4")
    rows = np.concatenate([corners, np.tile(np.array([0, 0, 1], "f4"), (3, 1))], axis=1)
    builder.strided(rows, {"componentType": 5126}, {"componentType": 5126, "byteOffset": 12})
    primitives = [{"attributes": {"POSITION": 0, "NORMAL": 1}}, {"attributes": {"POSITION": 0}, "mode": 1}]
    builder.tree["meshes"] = [{"primitives": primitives}]
    builder.node(mesh=0)
    scene = load(tmp_path, builder)
    (part,) = scene.objects[0].parts
    cross = vectors(part.mesh.vertices, part.mesh.faces)
    np.testing.assert_allclose(part.mesh.normals[part.mesh.faces].mean(axis=1), cross, atol=1e-6)
    assert scene.omissions == ("scene.glb asks for what is not drawn: points and lines",)


def animated(interpolation="LINEAR", scale=False):
    builder = with_camera(GltfBuilder())
    child = builder.node(root=False, mesh=triangle(builder), name="moon", translation=[2, 0, 0])
    node = builder.node(name="pivot", children=[child])
    translations = np.array([[0, 0, 0], [0, 1, 0], [0, 2, 0]])
    if interpolation == "CUBICSPLINE":
        slope = np.tile([0, 2, 0], (3, 1))
        translations = np.stack([slope, translations, slope], axis=1)
    times = builder.clip(node, "translation", [0, 0.5, 1], translations, interpolation)
    builder.clip(node, "rotation", times, [Rotation.from_euler("y", a, degrees=True).as_quat() for a in (0, 60, 120)])
    if scale:
        builder.clip(node, "scale", times, [[1, 1, 1], [2, 2, 2], [3, 3, 3]], None)
    builder.tree["animations"][0]["name"] = "turn"
    return builder


@pytest.mark.parametrize("interpolation", ["LINEAR", "CUBICSPLINE"])
def test_animation_moves_children_along(tmp_path, interpolation):
    """The moon circles the pivot at constant rate while both rise: p(t) = (2 cos wt, 2t, -2 sin wt) in the file."""
    (moon,) = load(tmp_path, animated(interpolation)).objects
    w = math.radians(120)
    for t in (0.0, 0.2, 0.37, 0.5, 0.81, 1.0):
        expected = Z_UP[:3, :3] @ [2 * math.cos(w * t), 2 * t, -2 * math.sin(w * t)]
        np.testing.assert_allclose(moon.path.pose(round(t * 1e9))[:3, 3], expected, atol=1e-5)
    D = moon.path.derivative(370_000_000)[:3, 3]
    np.testing.assert_allclose(
        D, Z_UP[:3, :3] @ [-2 * w * math.sin(w * 0.37), 2, -2 * w * math.cos(w * 0.37)], atol=1e-3
    )


def test_cubic_splines_leave_a_key_by_its_out_tangent(tmp_path):
    """Specification, appendix C.4: the tangent out of key k is its third value, the one into k + 1 that key's first."""
    builder = with_camera(GltfBuilder())
    node = builder.node(mesh=triangle(builder))
    keys = [[[0, 7, 0], [0, 0, 0], [0, 5, 0]], [[0, -3, 0], [0, 1, 0], [0, 9, 0]]]
    builder.clip(node, "translation", [0, 2], keys, "CUBICSPLINE")
    (channel,) = gltf.read(builder.write(tmp_path / "a.glb")).tracks(0)
    for t in (0.0, 0.3, 1.0, 1.7, 2.0):
        s, h = t / 2, 2.0
        expected = h * (s**3 - 2 * s**2 + s) * 5 + (3 * s**2 - 2 * s**3) * 1 + h * (s**3 - s**2) * -3
        assert channel.at(t)[0][1] == pytest.approx(expected, abs=1e-6)
    assert (channel.at(1e-4)[0][1] - channel.at(0)[0][1]) / 1e-4 == pytest.approx(5, rel=1e-3)


@pytest.mark.parametrize("flip", [(-1, 1, 1), (1, -1, 1), (-1, -1, -1), (2, -3, 0.5)])
def test_a_mirrored_node_faces_and_shines_outwards(tmp_path, flip):
    """A negative determinant turns the faces round and leaves the file's normals pointing out of the body."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    builder = with_camera(GltfBuilder())
    builder.node(mesh=builder.mesh(ball.vertices, ball.faces, normals=ball.vertices), name="ball", scale=list(flip))
    (ball,) = load(tmp_path, builder).objects
    (part,) = ball.parts
    points, turn = points_at(ball), ball.path.pose(0)[:3, :3]
    assert outwards(points, part.mesh.faces).min() > 0
    # An ellipsoid's normal: its vertices' unit sphere stretched by the inverse factors. The y axis becomes z.
    size = np.abs([flip[0], flip[2], flip[1]])
    normal = points / size**2
    np.testing.assert_allclose(
        part.mesh.normals @ turn.T, normal / np.linalg.norm(normal, axis=1, keepdims=True), atol=1e-5
    )
    document = gltf.read(tmp_path / "scene.glb")
    ((node, mesh),) = [(i, n.mesh) for i, n in document.nodes.items() if n.mesh is not None]
    (piece,) = (transformed(p, document.world(node)) for p in document.raw_meshes(mesh))
    assert (piece.normals * piece.vertices).sum(axis=1).min() > 0
    # Before make_mesh, which would mend a closed body.
    assert outwards(piece.vertices, piece.faces).min() > 0


def test_animation_choices_and_limits(tmp_path):
    assert load(tmp_path, animated(), animation=None).objects[0].path.is_static
    assert not load(tmp_path, animated(), animation="turn").objects[0].path.is_static
    for builder, log in ((animated(scale=True), ()), (animated("STEP"), ())):
        scene = load(tmp_path, builder)
        assert scene.objects[0].deforms and scene.objects[0].path.is_static and scene.log == log
    with pytest.raises(
        ConfigError, match="scene.animation: no such animation in the file .got 'spin'.; expected one of: turn"
    ):
        load(tmp_path, animated(), animation="spin")


def test_a_camera_and_a_shape_that_jump_say_when(tmp_path):
    builder = animated("STEP")
    for channel in builder.tree["animations"][0]["channels"]:
        channel["target"]["node"] = 0
    shape = load(tmp_path, with_camera(arm_file("STEP", morphs=True))).objects[0].parts[0].mesh
    moved = shape.deformer.jumps(0, T1)
    at = lambda t: shape.deformer.positions(shape, t)
    assert moved and all(np.abs(at(t) - at(t + 1)).max() > 0.1 for t in moved)
    path = load(tmp_path, builder).camera_path
    jumps = path.jumps(0, T1)
    assert jumps and all(not np.array_equal(path.pose(t), path.pose(t + 1)) for t in jumps)
    assert load(tmp_path, animated()).camera_path.is_static


def file_scene(tmp_path, builder=None, **tree):
    if builder is not None:
        builder.write(tmp_path / "scene.glb")
    config = validate(FileSceneConfig, {"kind": "file", "path": "scene.glb", **tree}, where="scene")
    return build_scene(config, SETTINGS, 0, T1, base=tmp_path)


def test_file_scene(tmp_path):
    scene = file_scene(tmp_path, animated(), light={"unlit": True, "sun": 3}, background=0.7)
    assert (
        scene.background == 0.7
        and scene.light.sun == 3
        and all(p.material.unlit for o in scene.objects for p in o.parts)
    )
    posed = file_scene(tmp_path, pose={"position": [0, -5, 1], "look_at": [0, 0, 1]})
    assert not any(p.material.unlit for o in posed.objects for p in o.parts), "what the file lights stays lit"
    np.testing.assert_allclose(posed.camera_path.pose(0)[:3, 2], [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize(
    "tree, builder, expected",
    [
        ({"path": "gone.glb"}, None, "scene.path: no such file (got 'gone.glb'); expected a gltf or glb file"),
        ({"path": "a.obj"}, None, "scene.path: not a glTF scene (got 'a.obj')"),
        (
            {"camera": "side"},
            animated,
            "scene.camera: no such camera in the file (got 'side'); expected one of: main, eye, or an index below 1",
        ),
        ({"camera": 3}, animated, "scene.camera: no such camera in the file (got 3)"),
        ({}, triangle_file, "scene.pose: the file has no camera"),
        ({}, lambda: with_camera(GltfBuilder()), "the scene has no faces"),
    ],
)
def test_bad_file_scenes(tmp_path, tree, builder, expected):
    (tmp_path / "a.obj").write_text("")
    assert expected in refusal((ConfigError, AssetError), file_scene, tmp_path, builder and builder(), **tree)


def lit(lights=None, node=None, **placed):
    """A scene file with one light on a node of its own."""
    builder = triangle_file(with_camera(GltfBuilder()))
    given = [{"type": "spot", "intensity": 68.3, "color": [1, 0.5, 0], "spot": {"innerConeAngle": 0.1}}]
    builder.tree["extensions"] = {"KHR_lights_punctual": {"lights": given if lights is None else lights}}
    builder.node(name="lamp", extensions={"KHR_lights_punctual": node or {"light": 0}}, **placed)
    return builder


def test_lights_of_a_file(tmp_path):
    """Candela and lux, places, directions (along -z of the node) and cones; the sky is the configuration's."""
    down = Rotation.from_euler("x", -90, degrees=True).as_quat().tolist()
    scene = file_scene(tmp_path, lit(translation=[1, 2, 3], rotation=down), lights="file", lights_gain=2.0)
    (lamp,) = scene.light.lamps
    assert lamp.kind == "spot" and lamp.inner == 0.1 and lamp.outer == pytest.approx(math.pi / 4)
    assert lamp.strength == pytest.approx([0.2 / math.pi, 0.1 / math.pi, 0.0])  # 68.3 cd / 683 lm/W, twice
    np.testing.assert_allclose(lamp.path.pose(0)[:3, 3], [1, -3, 2], atol=1e-9)
    np.testing.assert_allclose(lamp.path.pose(0)[:3, 2], [0, 0, 1], atol=1e-7)  # shines down
    assert scene.light.sun == 0 and scene.light.sky == 0.4 and not scene.omissions
    plain = file_scene(tmp_path, lit())
    assert plain.light.plain and "lights (the configuration's sun and sky shine)" in plain.omissions[0]
    sun = lit(lights=[{"type": "directional"}, {"type": "point", "range": 4.0}])
    (lamp,) = file_scene(tmp_path, sun, lights="file").light.lamps
    assert lamp.kind == "sun" and lamp.strength == pytest.approx([1 / 683 / math.pi] * 3)
    (lamp,) = file_scene(tmp_path, lit(lights=[{"type": "point", "range": 4.0}]), lights="file").light.lamps
    assert lamp.kind == "point" and lamp.reach == 4.0


def test_a_light_moves_with_its_node(tmp_path):
    builder = animated()
    moon = next(n for n in builder.tree["nodes"] if n.get("name") == "moon")
    moon["extensions"] = {"KHR_lights_punctual": {"light": 0}}
    builder.tree["extensions"] = {"KHR_lights_punctual": {"lights": [{"type": "point"}]}}
    scene = file_scene(tmp_path, builder, lights="file")
    (lamp,), (body,) = scene.light.lamps, scene.objects
    assert not lamp.path.is_static
    for t in (0, T1 // 3, T1):
        np.testing.assert_allclose(lamp.path.pose(t), body.path.pose(t), atol=1e-6)


def test_more_lights_than_shine(tmp_path):
    """The strongest do, and the others are said."""
    builder = lit(lights=[{"type": "point", "intensity": 10.0 * k} for k in range(40)])
    for k in range(1, 40):
        builder.node(extensions={"KHR_lights_punctual": {"light": k}})
    scene = file_scene(tmp_path, builder, lights="file")
    assert len(scene.light.lamps) == 32 and min(la.strength[0] for la in scene.light.lamps) > 79 / 683 / math.pi
    assert "8 of 40 lights (the weakest; at most 32 shine)" in scene.omissions[0]


@pytest.mark.parametrize(
    "builder, tree, expected",
    [
        (animated, {}, "scene.lights: the file has no lights .got 'file'.; expected config"),
        (lit, {"light": {"unlit": True}}, "scene.lights: these lights have no effect .got 'file'."),
        (lambda: lit(node={"light": 3}), {}, "reference to lights that does not exist.*got 3"),
        (lambda: lit(lights=[{"type": "area"}]), {}, "KHR_lights_punctual: .*lights.0.type"),
        (lambda: lit(lights=[{"type": "point", "intensity": -1}]), {}, "lights.0.intensity.*got -1"),
        (lambda: lit(lights=[{"type": "spot", "spot": {"innerConeAngle": 1.6}}]), {}, "innerConeAngle.*got 1.6"),
    ],
)
def test_bad_lights_of_a_file(tmp_path, builder, tree, expected):
    refusal((AssetError, ConfigError), file_scene, tmp_path, builder(), lights="file", match=expected, **tree)


def broken(change):
    builder = triangle_file(with_camera(GltfBuilder()))
    change(builder.tree)
    return builder


@pytest.mark.parametrize(
    "change, problem",
    [
        (lambda t: t["nodes"].append({"children": [2]}) or t["scenes"][0]["nodes"].append(2), "the nodes are no tree"),
        (lambda t: t["nodes"][1].update(mesh=9), "a reference to meshes that does not exist"),
        (
            lambda t: t["nodes"][1].update(translation=[float("nan"), 0, 0]),
            "nodes.1.translation.0: input should be a finite number",
        ),
        (lambda t: t["nodes"][1].update(rotation="no"), "no valid glTF"),
        (lambda t: t["meshes"][0]["primitives"][0].update(material=4), "a reference to materials that does not exist"),
        (lambda t: t["accessors"][0].update(bufferView=77), "a reference to bufferViews that does not exist"),
        (
            lambda t: t["accessors"][0].update(byteOffset=-8),
            "accessors.0.byteOffset: input should be greater than or equal to 0) (got -8)",
        ),
        (lambda t: t["accessors"][0].update(byteOffset=8), "reaches outside its buffer"),
        (lambda t: t["accessors"][0].update(type="VEC9"), "accessors.0.type: input should be"),
        (
            lambda t: t["accessors"][0].update(count="3"),
            "accessors.0.count: input should be a valid integer) (got '3')",
        ),
        (
            lambda t: t.update(extensionsRequired=["KHR_draco_mesh_compression"]),
            "needs the extension KHR_draco_mesh_compression, which BlinkGL does not draw",
        ),
        (lambda t: t.update(meshes={"a": 1}), "no valid glTF"),
        (lambda t: t["cameras"][0].update(type="orthographic"), "not a perspective one"),
    ],
)
def test_broken_files_are_named(tmp_path, change, problem):
    assert problem in refusal(AssetError, load, tmp_path, broken(change), intrinsics="file")


def test_our_reader_agrees_with_trimesh_on_real_files():
    """Same triangles, corner normals and texture coordinates, all 81 files. Two independent readers."""
    for path in sorted(shared("data/assets/models_cc0").glob("*.glb")):
        theirs = trimesh.load_scene(path, process=False)
        document = gltf.read(path)
        meshes = [(i, n.mesh) for i, n in document.nodes.items() if n.mesh is not None]
        mine = [transformed(p, Z_UP @ document.world(i)) for i, m in meshes for p in document.raw_meshes(m)]
        corners = []
        for name in theirs.graph.nodes_geometry:
            matrix, geometry = theirs.graph[name]
            g = theirs.geometry[geometry]
            matrix = Z_UP @ matrix
            corners.append(
                np.hstack(
                    [
                        trimesh.transform_points(g.vertices[g.faces].reshape(-1, 3), matrix),
                        g.visual.uv[g.faces].reshape(-1, 2) * [1, -1] + [0, 1],
                    ]
                )
            )
        corners = np.concatenate(corners)
        ours = np.concatenate(
            [np.hstack([p.vertices[p.faces].reshape(-1, 3), p.uvs[p.faces].reshape(-1, 2)]) for p in mine]
        )
        assert ours.shape == corners.shape, path.name
        order = lambda a: a[np.lexsort(np.round(a, 4).T)]
        np.testing.assert_allclose(order(ours), order(corners), atol=2e-4, err_msg=path.name)


def test_a_scene_of_which_nothing_is_visible_is_empty(tmp_path):
    """Scale 0 and opacity 0 hide; that all is hidden is said. A pool, whose objects have a size, refuses it."""
    for node, material in (({"scale": [0, 0, 0]}, {}), ({}, {"alphaMode": "MASK"}), ({}, {"alphaMode": "BLEND"})):
        builder = with_camera(GltfBuilder())
        clear = {"baseColorFactor": [1, 1, 1, 0 if material else 1]}
        builder.tree["materials"] = [{"pbrMetallicRoughness": clear, **material}]
        builder.node(mesh=triangle(builder, material=0), **node)
        scene = load(tmp_path, builder)
        assert scene.objects == () and "all of it is hidden, transparent or without area" in scene.omissions[0]
        asset = load_asset(tmp_path / "scene.glb")
        assert asset.parts == () and asset.omissions == scene.omissions
        refusal(AssetError, asset.normalised, match="scene: nothing of the file is visible")


def test_an_animated_camera_below_a_growing_node_stays_rigid(tmp_path):
    """Its place follows the scale, its axes do not."""
    builder = with_camera(GltfBuilder())
    camera = next(i for i, node in enumerate(builder.tree["nodes"]) if "camera" in node)
    builder.tree["nodes"][camera].update(translation=[1, 0, 0])
    builder.tree["scenes"][0]["nodes"] = [builder.node(mesh=triangle(builder)), builder.node(children=[camera])]
    growing = len(builder.tree["nodes"]) - 1
    times = builder.clip(growing, "rotation", [0, 1], [[0, 0, 0, 1], [0, HALF, 0, HALF]], None)
    builder.clip(growing, "scale", times, [[1, 1, 1], [3, 3, 3]], None)
    path = load(tmp_path, builder).camera_path
    for t in (0.0, 0.3, 0.8):
        T, D, h = path.pose(round(t * 1e9)), path.derivative(round(t * 1e9)), 1e-6
        a, s = math.pi / 2 * t, 1 + 2 * t
        np.testing.assert_allclose(T[:3, 3], Z_UP[:3, :3] @ [s * math.cos(a), 0, -s * math.sin(a)], atol=1e-6)
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
        ahead, behind = (path.pose(round((t + k) * 1e9)) for k in (h, -h if t else 0.0))
        np.testing.assert_allclose(D, (ahead - behind) / (2 * h if t else h), atol=2e-5)
    v, w = path.speed_bound(0, T1)
    assert v >= math.hypot(2, 3 * math.pi / 2) - 1e-6 and math.pi / 2 <= w < 2.5
