"""What a file asks for and is not drawn is said: every feature by name, once per file."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image
from pydantic import ValidationError

from blinkgl.config.camera import CameraConfig
from blinkgl.config.scene import PoolConfig
from blinkgl.errors import AssetError
from blinkgl.scene.importing import gltf, gltf_schema as schema
from blinkgl.scene.importing.mesh_files import load_asset
from blinkgl.scene.worlds.from_file import from_document
from blinkgl.scene.worlds.pool import object_pool
from tests.refusals import refusal
from tests.scene.gltf_files import GltfBuilder, triangle, triangle_file

CAMERA = CameraConfig(width=64, height=48).model
MATT = {"metallicFactor": 0}


def png(folder, name="t.png"):
    Image.new("RGB", (4, 4), (10, 200, 30)).save(folder / name)
    return (folder / name).read_bytes()


def said(path, **options) -> list[str]:
    """The features in the file's line."""
    lines = load_asset(path, **options).omissions
    assert len(lines) <= 1 and all(line.startswith(f"{path.name} asks for what is not drawn: ") for line in lines)
    return lines[0].partition(": ")[2].split("; ") if lines else []


def glb(tmp_path, material=None, *, change=None, uvs=((0, 0), (1, 0), (0, 1)), image=False, samplers=None, **arrays):
    """A triangle of this material (its texture, if ``image``, in a buffer), written to a.glb."""
    builder = GltfBuilder()
    if material is not None:
        builder.tree["materials"] = [material]
    if image:
        builder.tree["images"] = [{"bufferView": builder.view(png(tmp_path))}]
        builder.tree["textures"] = [{"source": 0, **({"sampler": 0} if samplers else {})}]
        builder.tree.update({"samplers": samplers} if samplers else {})
    builder.node(mesh=triangle(builder, uvs=uvs, material=None if material is None else 0))
    for name, (values, kind) in arrays.items():
        builder.tree["meshes"][0]["primitives"][0]["attributes"][name] = builder.array(values, kind)
    if change:
        change(builder.tree)
    return builder.write(tmp_path / "a.glb")


TEXTURED = {"pbrMetallicRoughness": {**MATT, "baseColorTexture": {"index": 0}}}


@pytest.mark.parametrize(
    "material, expected",
    [
        ({"pbrMetallicRoughness": MATT}, []),
        ({"pbrMetallicRoughness": MATT, "emissiveFactor": [0, 0, 0.5]}, []),
        ({"pbrMetallicRoughness": MATT, "alphaMode": "BLEND"}, ["alpha BLEND (drawn opaque)"]),
        ({"pbrMetallicRoughness": MATT, "alphaMode": "MASK"}, []),
        ({"pbrMetallicRoughness": {**MATT, "roughnessFactor": 0.4}}, []),
        ({"pbrMetallicRoughness": MATT, "occlusionTexture": {"index": 0}}, ["occlusion maps"]),
        (
            {"pbrMetallicRoughness": MATT, "extensions": {"KHR_materials_transmission": {"transmissionFactor": 1}}},
            ["KHR_materials_transmission"],
        ),
        ({"extensions": {"KHR_materials_unlit": {}}, "emissiveFactor": [1, 1, 1]}, []),
        # unlit is drawn, and says what there is to see
    ],
)
def test_materials(tmp_path, material, expected):
    path = glb(tmp_path, material)
    assert said(path) == expected
    assert said(path, keep_materials=False) == []  # replaced by the pool's textures: nothing of it was asked for


@pytest.mark.parametrize(
    "sampler, uvs, expected",
    [
        ({"wrapS": 33071}, [[0, 0], [2, 0], [0, 1]], []),
        ({"wrapT": 33648}, [[0, 0], [1, 0], [0, -1]], []),
        ({"wrapS": 33071, "wrapT": 33071}, [[0, 0], [1, 0], [0, 1]], []),  # never leaves the image
        ({"magFilter": 9728}, [[0, 0], [1, 0], [0, 1]], ["unfiltered textures (drawn smooth)"]),
        ({"wrapS": 10497}, [[0, 0], [5, 0], [0, 1]], []),
    ],
)
def test_samplers(tmp_path, sampler, uvs, expected):
    assert said(glb(tmp_path, TEXTURED, image=True, samplers=[sampler], uvs=uvs)) == expected


def test_vertex_colours(tmp_path):
    """One colour on all vertices is a factor; others are the mesh's own; those of faces are said."""
    path = glb(
        tmp_path,
        {"pbrMetallicRoughness": {**MATT, "baseColorFactor": [0.5, 1, 1, 1]}},
        COLOR_0=(np.tile(np.array([0.5, 0.25, 1], "f4"), (3, 1)), "VEC3"),
    )
    assert said(path) == [] and load_asset(path).parts[0].material.base_color == (0.25, 0.25, 1.0)
    path = glb(tmp_path, None, COLOR_0=(np.eye(3, dtype="f4"), "VEC3"))
    assert said(path) == []
    mesh = load_asset(path).parts[0].mesh
    np.testing.assert_array_equal(mesh.colours[np.argsort(mesh.vertices @ [1, 2, 4])], np.eye(3))
    assert load_asset(path, keep_materials=False).parts[0].mesh.colours is None
    header = (
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nproperty "
        "uchar red\nproperty uchar green\nproperty uchar blue\nelement face 1\nproperty list uchar int "
        "vertex_indices\nend_header\n"
    )
    for last, expected in (("0 188 0", [0, 0.5029, 0]), ("255 0 0", None)):
        (tmp_path / "a.ply").write_text(header + f"0 0 0 255 0 0\n1 0 0 255 0 0\n0 1 0 {last}\n3 0 1 2\n")
        assert said(tmp_path / "a.ply") == []
        (part,) = load_asset(tmp_path / "a.ply").parts
        if expected is None:
            assert part.mesh.colours is None and part.material.base_color == (1.0, 0.0, 0.0)
        else:
            np.testing.assert_allclose(part.mesh.colours[part.mesh.vertices[:, 1].argmax()], expected, atol=1e-3)
            assert part.material.base_color == (1.0, 1.0, 1.0)
    (tmp_path / "a.obj").write_text("v 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 0 1 0\nf 1 2 3\n")
    assert said(tmp_path / "a.obj") == [] and load_asset(tmp_path / "a.obj").parts[0].mesh.colours is not None


def test_clips_that_nobody_plays_and_lines(tmp_path):
    def change(tree):
        tree["meshes"][0]["primitives"].append({"attributes": {"POSITION": 0}, "mode": 1})
        tree["animations"] = [{"channels": [], "samplers": []}]

    path = glb(tmp_path, change=change)
    assert sorted(said(path)) == ["animations (the rest pose is drawn)", "points and lines"]
    assert said(path, keep_materials=False) == said(path)  # shape is asked for whatever the material
    with pytest.raises(AssetError, match="no valid glTF .JOINTS_0 without WEIGHTS_0"):
        load_asset(glb(tmp_path, JOINTS_0=(np.zeros((3, 4), "u1"), "VEC4")))


def test_extensions_that_are_used(tmp_path):
    def change(tree):
        tree["extensionsUsed"] = [
            "KHR_texture_transform",
            "EXT_mesh_gpu_instancing",
            "KHR_lights_punctual",
            "KHR_xmp_json_ld",
        ]
        tree["nodes"][0]["extensions"] = {"KHR_lights_punctual": {"light": 0}}

    assert said(glb(tmp_path, change=change)) == [
        "EXT_mesh_gpu_instancing",
        "lights (the configuration's sun and sky shine)",
    ]
    path = glb(
        tmp_path,
        TEXTURED,
        image=True,
        change=lambda t: t["textures"].__setitem__(0, {"extensions": {"KHR_texture_basisu": {"source": 0}}}),
    )
    assert (
        said(path) == ["textures of another kind (KHR_texture_basisu)"]
        and load_asset(path).parts[0].material.texture is None
    )


@pytest.mark.parametrize(
    "extension",
    [
        "KHR_draco_mesh_compression",
        "EXT_meshopt_compression",
        "KHR_texture_basisu",
        "EXT_mesh_gpu_instancing",
        "KHR_materials_pbrSpecularGlossiness",
        "KHR_materials_transmission",
        "ACME_unheard_of",
    ],
)
def test_an_extension_that_makes_another_scene_is_refused_when_required(tmp_path, extension):
    path = glb(tmp_path, change=lambda t: t.update(extensionsUsed=[extension], extensionsRequired=[extension]))
    assert refusal(AssetError, load_asset, path).startswith(
        f"{path}: the file needs the extension {extension}, which BlinkGL does not draw; expected a glTF 2.0 export"
    )


@pytest.mark.parametrize("extension", ["KHR_lights_punctual", "KHR_materials_clearcoat", "KHR_texture_transform"])
def test_an_extension_of_light_alone_is_not_refused(tmp_path, extension):
    load_asset(glb(tmp_path, change=lambda t: t.update(extensionsRequired=[extension])))


def test_a_scene_names_the_cameras_and_clips_that_it_does_not_use(tmp_path):
    builder = GltfBuilder()
    builder.tree["cameras"] = [
        {"type": "orthographic", "name": "plan"},
        {"type": "perspective", "name": "eye", "perspective": {"yfov": 0.8}},
    ]
    for k in range(2):
        builder.node(camera=k)
    clips = [{"name": name, "channels": [], "samplers": []} for name in ("walk", "run")]
    path = triangle_file(builder, {"animations": clips}).write(tmp_path / "s.glb")
    read = lambda **chosen: from_document(gltf.read(path), CAMERA, 0, 10**9, **chosen).omissions
    (line,) = read()
    assert "animations beside 'walk' (scene.animation chooses one of: walk, run)" in line
    assert (
        "cameras beside 'plan' (scene.camera chooses one of: plan, node-0, eye, node-1)" in line
        and "an orthographic camera (drawn in perspective)" in line
    )
    assert read(camera_name="eye", animation="run") == ()


def test_obj_materials(tmp_path):
    png(tmp_path)
    (tmp_path / "m.mtl").write_text(
        "newmtl a\nKd 1 1 1\nKs 0.5 0.5 0.5\nKe 0 0 0\nd 0.5\nmap_Kd t.png\nmap_Bump n.png\nmap_Ke e.png\n"
    )
    (tmp_path / "a.obj").write_text(
        "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl a\nf 1/1 2/2 3/3\n"
    )
    drawn_without = ["shine (drawn matt)", "normal maps", "emissive light", "transparency (drawn opaque)"]
    assert said(tmp_path / "a.obj") == drawn_without
    assert said(tmp_path / "a.obj", keep_materials=False) == []
    (tmp_path / "t.png").unlink()
    assert "'t.png', which is missing" in said(tmp_path / "a.obj")


def test_a_pool_and_a_trimesh_scene_say_it_too(tmp_path):
    glb(tmp_path, {"alphaMode": "BLEND", "pbrMetallicRoughness": MATT})
    pool = object_pool(
        PoolConfig(primitives=(), folders=(str(tmp_path),), keep_materials=True, test_fraction=0), tmp_path
    )
    for _ in range(2):  # loaded, and from the cache
        assert pool.draw(np.random.default_rng(0), "train").omissions == (
            "a.glb asks for what is not drawn: alpha BLEND (drawn opaque)",
        )


def test_draco_beside_plain_geometry_is_ignored(tmp_path):
    """The extension allows an uncompressed fallback, which is then simply what is drawn."""
    draco = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
    path = glb(tmp_path, change=lambda t: t["meshes"][0]["primitives"][0].update(extensions=draco))
    assert len(load_asset(path).parts[0].mesh.faces) == 1
    path = glb(
        tmp_path,
        change=lambda t: (
            t["meshes"][0]["primitives"][0].update(extensions=draco),
            t["accessors"][0].pop("bufferView"),
        ),
    )
    refusal(AssetError, load_asset, path, match="needs the extension KHR_draco_mesh_compression")


def test_meshopt_without_a_fallback_is_named(tmp_path):
    builder = triangle_file()
    builder.tree["buffers"] = [
        {"byteLength": len(builder.data), "extensions": {"EXT_meshopt_compression": {"fallback": True}}}
    ]
    (tmp_path / "a.gltf").write_text(json.dumps(builder.tree))
    refusal(AssetError, load_asset, tmp_path / "a.gltf", match="needs the extension EXT_meshopt_compression")


# --- What a glTF file leaves out is as the specification says, and what it may say has an end.

DEFAULTS = {  # glTF 2.0, section 5; extensions: KHR_texture_transform
    schema.Buffer: {"byteLength": 0},
    schema.BufferView: {"buffer": 0, "byteOffset": 0, "byteStride": 0},
    schema.Accessor: {"componentType": 5126, "type": "VEC3", "count": 1, "byteOffset": 0, "normalized": False},
    schema.Transform: {"offset": [0, 0], "scale": [1, 1], "rotation": 0.0},
    schema.TextureInfo: {"index": 0, "texCoord": 0},
    schema.Pbr: {"baseColorFactor": [1, 1, 1, 1], "metallicFactor": 1.0, "roughnessFactor": 1.0},
    schema.Material: {"emissiveFactor": [0, 0, 0], "alphaMode": "OPAQUE", "doubleSided": False},
    schema.Primitive: {"attributes": {}, "mode": 4},
    schema.Node: {"children": [], "translation": [0, 0, 0], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1]},
    schema.Sampler: {"wrapS": 10497, "wrapT": 10497, "magFilter": None},
    schema.AnimationSampler: {"input": 0, "output": 0, "interpolation": "LINEAR"},
}
NEEDED = ("buffer", "componentType", "type", "count", "index", "attributes", "input", "output")


@pytest.mark.parametrize("part", DEFAULTS, ids=lambda part: part.__name__)
def test_what_is_left_out(part):
    given = {k: v for k, v in DEFAULTS[part].items() if k in NEEDED}
    made = part.model_validate(given)
    assert {k: getattr(made, k) for k in DEFAULTS[part]} == DEFAULTS[part]


@pytest.mark.parametrize(
    "part, key, fine, bad",
    [
        (schema.Node, "translation", [1e12, -1e12, 0], [1.1e12, 0, 0]),
        (schema.Node, "translation", [0, 0, -1e12], [0, -1.1e12, 0]),
        (schema.Node, "translation", [1, 2, 3], [1, 2]),
        (schema.Node, "scale", [1, 2, 3], [1, 2, 3, 4]),
        (schema.Node, "rotation", [0, 0, 0, 1e-8], [0, 0, 0, 1e-10]),
        (schema.Node, "rotation", [1, 0, 0, 0], [0, 0, 1]),
        (schema.Node, "rotation", [0, 1, 0, 0], [0, 0, 0, 0, 1]),
        (schema.Node, "matrix", [1.0] * 16, [1.0] * 15),
        (schema.Node, "matrix", [1.0] * 16, [1.0] * 17),
        (schema.Node, "mesh", 2**31 - 1, 2**31),
        (schema.Node, "mesh", 0, -1),
        (schema.Buffer, "byteLength", 2**53, 2**53 + 1),
        (schema.Buffer, "byteLength", 0, -1),
        (schema.BufferView, "byteStride", 65536, 65537),
        (schema.BufferView, "byteStride", 0, -1),
        (schema.TextureInfo, "texCoord", 255, 256),
        (schema.TextureInfo, "texCoord", 0, -1),
        (schema.Transform, "texCoord", 255, 256),
        (schema.Transform, "offset", [1, 2], [1, 2, 3]),
        (schema.Transform, "scale", [1, 2], [1]),
        (schema.Pbr, "baseColorFactor", [0, 1e9, 0, 1], [0, 1.1e9, 0, 1]),
        (schema.Pbr, "baseColorFactor", [0, 0, 0, 0], [0, -0.1, 0, 1]),
        (schema.Pbr, "baseColorFactor", [0, 0, 0, 0], [0, 0, 0]),
        (schema.Pbr, "baseColorFactor", [0, 0, 0, 0], [0, 0, 0, 0, 0]),
        (schema.Pbr, "metallicFactor", 0, None),
        (schema.Pbr, "roughnessFactor", 0.5, "0.5"),
        (schema.Pbr, "roughnessFactor", 0.5, float("nan")),
        (schema.Material, "emissiveFactor", [0, 0, 1], [0, 1]),
        (schema.Material, "emissiveFactor", [0, 0, 1], [0, 1, 1, 1]),
        (schema.Material, "alphaMode", "BLEND", "GLASS"),
        (schema.Material, "doubleSided", True, 1),
        (schema.Primitive, "mode", 6, 7),
        (schema.Primitive, "mode", 0, -1),
        (schema.Perspective, "yfov", 3.1414, 3.1415),
        (schema.Perspective, "yfov", 1.1e-4, 1e-4),
    ],
)
def test_what_may_be_said_ends_somewhere(part, key, fine, bad):
    given = {k: v for k, v in DEFAULTS.get(part, {}).items() if k in NEEDED}
    assert getattr(part.model_validate({**given, key: fine}), key) == fine
    with pytest.raises(ValidationError):
        part.model_validate({**given, key: bad})
