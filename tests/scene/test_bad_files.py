"""Files that claim too much, are of the wrong shape, or are cut and flipped at random: one line that names the file,
little memory."""

import json
import os
import random
import resource
import struct

import numpy as np
import pytest
import trimesh
from PIL import Image

from blinkgl.config.camera import CameraConfig
from blinkgl.errors import AssetError, BlinkGLError
from blinkgl.scene.importing import gltf
from blinkgl.scene.importing.mesh_files import load_asset
from blinkgl.scene.reading import contents, reading
from blinkgl.scene.worlds.from_file import from_document
from tests.refusals import refusal
from tests.scene.gltf_files import GltfBuilder, triangle

CAMERA = CameraConfig(width=64, height=48).model


PIXEL = "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAIAAACQd1PeAAAADElEQVR4nGP4z8AAAAMBAQDJ/pLvAAAAAElFTkSuQmCC"
"""A PNG of one pixel, base64."""


def everything() -> GltfBuilder:
    """A file with a bit of all that the reader reads."""
    builder = GltfBuilder()
    builder.tree["materials"] = [
        {
            "pbrMetallicRoughness": {
                "baseColorTexture": {"index": 0, "extensions": {"KHR_texture_transform": {"scale": [2, 2]}}}
            }
        }
    ]
    builder.tree["images"] = [{"uri": "data:image/png;base64," + PIXEL}]
    builder.tree["samplers"] = [{"wrapS": 33071}]
    builder.tree["textures"] = [{"source": 0, "sampler": 0}]
    builder.tree["cameras"] = [{"type": "perspective", "perspective": {"yfov": 0.8, "znear": 0.02}}]
    node = builder.node(
        mesh=triangle(builder, normals=[[0, 0, 1]] * 3, uvs=[[0, 0], [1, 0], [0, 1]], material=0),
        translation=[0, 0, 0],
        rotation=[0, 0, 0, 1],
        scale=[1, 1, 1],
    )
    builder.node(camera=0)
    builder.clip(node, "rotation", [0, 1], [[0, 0, 0, 1]] * 2, None)
    return builder


def read_all(path):
    load_asset(path, max_faces=1000)
    return from_document(gltf.read(path, max_faces=1000), CAMERA, 0, 10**9, intrinsics="file")


def places(tree, path=()):
    """Every key and index below a JSON tree."""
    for key in tree if isinstance(tree, dict) else range(len(tree)) if isinstance(tree, list) else ():
        yield (*path, key)
        yield from places(tree[key], (*path, key))


JUNK = [
    None,
    True,
    -1,
    1.5,
    10**30,
    int("9" * 4000),
    "",
    "x" * 5000,
    [],
    {},
    [None],
    [0.0] * 16,
    [0, 0, 0, 0],
    1e308,
    float("nan"),
    2**31,
    10**9,
]


def test_every_place_of_a_gltf_may_hold_anything(tmp_path):
    """Type confusion at each place of the JSON: the file loads, or a BlinkGLError says what is wrong with it."""
    builder, path, refused = everything(), tmp_path / "a.glb", 0
    path.write_bytes(builder.glb())
    assert len(read_all(path).objects) == 1
    whole = json.dumps(builder.tree)
    for place in list(places(builder.tree)):
        for junk in random.Random(str(place)).sample(JUNK, 3):
            builder.tree = json.loads(whole)
            inner = builder.tree
            for step in place[:-1]:
                inner = inner[step]
            inner[place[-1]] = junk
            path.write_bytes(builder.glb())
            try:
                read_all(path)
            except BlinkGLError as error:
                refused += 1
                assert "\n" not in str(error) and ("a.glb" in str(error) or str(error).startswith("scene.")), (
                    place,
                    junk,
                )
    assert refused > 200


@pytest.mark.parametrize(
    "change, problem",
    [
        (lambda t: t["nodes"][0].update(translation=[0, 0]), "nodes.0.translation: list should have at least 3 items"),
        (lambda t: t["nodes"][0].update(matrix=[1] * 15), "nodes.0.matrix: list should have at least 16 items"),
        (lambda t: t["nodes"][0].update(rotation=[0, 0, 0, 0]), "nodes.0.rotation: a node's rotation is zero"),
        (lambda t: t["nodes"][0].update(mesh=True), "nodes.0.mesh: input should be a valid integer) (got True)"),
        (lambda t: t["nodes"][1].update(camera=9), "a reference to cameras that does not exist) (got 9)"),
        (lambda t: t["cameras"][0].update(perspective=[]), "cameras.0.perspective"),
        (
            lambda t: t["cameras"][0]["perspective"].update(yfov="wide"),
            "cameras.0.perspective.yfov: input should be a valid number) (got 'wide')",
        ),
        (
            lambda t: t["animations"][0].update(channels=3),
            "animations.0.channels: input should be a valid list) (got 3)",
        ),
        (
            lambda t: t["animations"][0]["samplers"][0].update(output=0),
            "the animation of rotation of node 'node-0' is corrupt",
        ),
        (
            lambda t: t["animations"][0]["samplers"][0].update(input=10**9),
            "a reference to accessors that does not exist",
        ),
        (
            lambda t: t["meshes"][0]["primitives"][0]["attributes"].update(NORMAL=2),
            "NORMAL does not fit the positions) (got '3 VEC2'); expected 3 VEC3",
        ),
        (lambda t: t["meshes"][0]["primitives"][0].update(indices=0), "the indices of mesh 0 are no whole numbers"),
        (
            lambda t: t.update(
                nodes=[{"children": [k + 1]} for k in range(400)] + [{"mesh": 0}], scenes=[{"nodes": [0]}]
            ),
            "nested more than 256 deep",
        ),
        (
            lambda t: t["images"][0].update(uri="data:image/png;base64,AAAA"),
            "the image is corrupt or of an unknown format",
        ),
        (lambda t: t["images"][0].update(uri="data:image/png;base64,A%"), "the embedded image is corrupt"),
    ],
)
def test_wrong_shapes_are_named(tmp_path, change, problem):
    builder = everything()
    change(builder.tree)
    path = builder.write(tmp_path / "a.glb")
    message = refusal(AssetError, read_all, path)
    assert message.startswith(str(path)) and problem in message


def unbacked(accessor: dict) -> None:
    """A thousand million zeros."""
    del accessor["bufferView"]
    accessor["count"] = 10**9


@pytest.mark.parametrize(
    "change, problem",
    [
        # positions, and what else a primitive or an animation points to, without a buffer behind it
        (lambda t: unbacked(t["accessors"][0]), "too many faces"),
        (lambda t: unbacked(t["accessors"][1]), "does not fit the positions"),
        (lambda t: unbacked(t["accessors"][3]), "too many faces"),
        (lambda t: [unbacked(t["accessors"][k]) for k in (4, 5)], "has no buffer and too many values"),
        (
            lambda t: t["accessors"][0].update(
                sparse={
                    "count": 10**9,
                    "indices": {"bufferView": 3, "componentType": 5125},
                    "values": {"bufferView": 0},
                }
            ),
            "reaches outside its buffer",
        ),
        (lambda t: t["accessors"][0].update(count=10**9), "too many faces"),
        (lambda t: t["bufferViews"][0].update(byteLength=2**40, byteOffset=2**40), "reaches outside its buffer"),
        (lambda t: t["bufferViews"][0].update(byteStride=65536), "reaches outside its buffer"),
    ],
)
def test_what_a_gltf_claims_is_not_allocated(tmp_path, change, problem):
    """Positions, indices, times and turns of 10**9: refused while memory stays where it was."""
    builder = everything()
    change(builder.tree)
    path = builder.write(tmp_path / "a.glb")
    assert path.stat().st_size < 4000
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refusal(AssetError, read_all, path, match=problem)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # KiB


def test_zeros_within_the_limit_are_an_accessor(tmp_path):
    builder = everything()
    builder.tree["accessors"][1].pop("bufferView")  # normals of zero are unusable, and made anew
    path = builder.write(tmp_path / "a.glb")
    assert (gltf.read(path).accessor(1) == 0).all()
    assert load_asset(path).parts[0].mesh.normals == pytest.approx(np.tile([0, -1, 0], (3, 1)))


PLY = (
    "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nelement face "
    "{}\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
)


@pytest.mark.parametrize(
    "name, text, problem",
    [
        ("a.ply", PLY.format("9" * 5000, 1), "too many vertex elements (got 'a number of 5000 digits')"),
        (
            "a.ply",
            PLY.format(3, 1).replace("3 0 1 2", "3 0 1 99999999"),
            "a face refers to a vertex that does not exist (got 99999999); expected 0 to 2",
        ),
        (
            "a.obj",
            "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 4294967295/1\n",
            "line 5: a face refers to a vertex that does not exist (got '4294967295'); expected 1 to 3, or -1 to -3",
        ),
        (
            "a.obj",
            "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 " + "9" * 5000 + "\n",
            "a face refers to a vertex that does not exist",
        ),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 x\n", "corrupt"),
        ("a.gltf", "[" * 100_000, "JSON cannot be read"),
        (
            "a.gltf",
            '{"asset": {"version": "2.0"}, "extras": ' + "[" * 500 + "]" * 500 + ', "scene": 1' + "0" * 5000 + "}",
            "JSON cannot be read",
        ),
        (
            "a.gltf",
            '{"asset": {"version": "2.0"}, "buffers": [{"uri": "' + "x" * 5000 + '", "byteLength": 4}]}',
            "refers to a file that is missing",
        ),
        ("a.gltf", '{"asset": {"version": "2.0", "minVersion": "2.1"}}', "no glTF 2.0 (got 'minVersion 2.1')"),
        ("a.gltf", '{"asset": []}', "asset: input should be a valid dictionary"),
        ("a.gltf", "[]", "its JSON: input should be a valid dictionary"),
    ],
)
def test_other_kinds(tmp_path, name, text, problem):
    (tmp_path / name).write_text(text)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    message = refusal(AssetError, load_asset, tmp_path / name)
    assert message.startswith(str(tmp_path / name)) and problem in message
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000


@pytest.mark.parametrize(
    "spoil",
    [
        lambda data: data[: len(data) // 2],
        lambda data: b"not an image",
        lambda data: b"",
        lambda data: data[:16] + struct.pack(">II", 60_000, 60_000) + data[24:],
    ],
)
@pytest.mark.parametrize("kind", ["obj", "ply"])
def test_a_broken_texture_beside_a_mesh_is_named(tmp_path, kind, spoil):
    noise = np.random.default_rng(0).integers(0, 255, (32, 32, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / "t.png")
    if kind == "obj":
        (tmp_path / "m.mtl").write_text("newmtl a\nmap_Kd t.png\n")
        (tmp_path / "a.obj").write_text(
            "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl a\nf 1/1 2/2 3/3\n"
        )
    else:
        (tmp_path / "a.ply").write_text(
            "ply\nformat ascii 1.0\ncomment TextureFile t.png\nelement vertex 3\nproperty float x\nproperty float "
            "y\nproperty float z\nproperty float s\nproperty float t\nelement face 1\nproperty list uchar int "
            "vertex_indices\nend_header\n0 0 0 0 0\n1 0 0 1 0\n0 1 0 0 1\n3 0 1 2\n"
        )
    path = tmp_path / f"a.{kind}"
    assert (load_asset(path).parts[0].material.texture.image == noise).all()
    (tmp_path / "t.png").write_bytes(spoil((tmp_path / "t.png").read_bytes()))
    assert refusal(AssetError, load_asset, path).startswith(str(tmp_path / "t.png") + ": the image is ")
    assert load_asset(path, keep_materials=False).parts[0].material.texture is None  # not asked for, not read


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    os.mkdir(tmp_path / "a.png")
    refusal(AssetError, contents, tmp_path / "a.png", "image", match="a.png: cannot read the image: Is a directory")
    refusal(AssetError, contents, tmp_path / "a\0.obj", "mesh", match="cannot read the mesh: .*embedded null")
    with open(tmp_path / "b.bin", "wb") as file:
        file.truncate(3_000_000_000)  # sparse
    with pytest.raises(
        AssetError, match="b.bin: the buffer file is too large .got '3000 MB'.; expected at most 2000 MB"
    ):
        contents(tmp_path / "b.bin", "buffer")


@pytest.mark.parametrize(
    "error",
    [
        ValueError("a\nb"),
        KeyError("a"),
        MemoryError(),
        RecursionError(),
        struct.error("x"),
        OverflowError(),
        UnboundLocalError("x"),
        SystemError("x"),
    ],
)
def test_whatever_a_loader_raises_names_the_file(error):
    with pytest.raises(AssetError) as raised, reading("mesh", "a.obj"):
        raise error
    assert (
        str(raised.value).startswith("a.obj: the mesh ")
        and "\n" not in str(raised.value)
        and raised.value.__cause__ is error
    )
    with pytest.raises(KeyboardInterrupt), reading("mesh", "a.obj"):
        raise KeyboardInterrupt


@pytest.mark.parametrize("name", ["a.stl", "b.stl", "a.ply", "b.ply", "a.obj", "a.glb"])
def test_cut_and_flipped_files(tmp_path, name):
    """A hundred mutants each: loaded or refused in a line about the file."""
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.5)
    exported = (
        everything().glb()
        if name == "a.glb"
        else ball.export(
            file_type="stl_ascii" if name == "b.stl" else name[2:], **({"encoding": "ascii"} if name == "b.ply" else {})
        )
    )
    whole = exported.encode() if isinstance(exported, str) else exported
    rng, refused = random.Random(name), 0
    for k in range(100):
        data = bytearray(whole)
        for _ in range(rng.choice([1, 4, 16])):
            data[rng.randrange(min(len(data), rng.choice([200, len(data)])))] ^= 1 << rng.randrange(8)
        if k % 3 == 0:
            del data[rng.randrange(len(data)) :]
        (tmp_path / name).write_bytes(data)
        try:
            load_asset(tmp_path / name, max_faces=100_000)
        except AssetError as error:
            refused += 1
            assert str(error).startswith(str(tmp_path)) and "\n" not in str(error)
    assert refused > 10
