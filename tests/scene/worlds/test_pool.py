"""Pools: splits by content, order, caching, sources, and what is refused."""

import json
import shutil
import struct
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from PIL import Image

from blinkgl.config.scene import PoolConfig, TexturesConfig
from blinkgl.errors import AssetError, ConfigError
from blinkgl.scene.importing.mesh_files import load_asset
from blinkgl.scene.worlds.pool import Cache, object_pool, split_of, texture_pool
from tests.refusals import refusal
from tests.scene.gltf_files import GltfBuilder, triangle_file
from tests.shared_data import shared

NOTHING = dict(primitives=())


def box(path, seed=0):
    rng = np.random.default_rng(seed)
    trimesh.creation.box(extents=rng.uniform(0.5, 2, 3)).export(path)
    return path


def test_split_is_a_fraction_of_hashes():
    rng = np.random.default_rng(0)
    hashes = [rng.bytes(16).hex() for _ in range(20_000)]
    tests = [h for h in hashes if split_of(h, 0.1) == "test"]
    assert abs(len(tests) - 2000) < 4 * np.sqrt(20_000 * 0.1 * 0.9)
    assert set(tests) <= {h for h in hashes if split_of(h, 0.2) == "test"}  # a larger fraction only adds
    assert all(split_of(h, 0.0) == "train" and split_of(h, 1.0) == "test" for h in hashes[:100])


def test_splits_are_disjoint_and_complete():
    for pool in (object_pool(PoolConfig(), "."), texture_pool(TexturesConfig(), ".")):
        sides = {s: {e.source_hash for group in pool.split(s).values() for e in group} for s in ("train", "test")}
        assert not sides["train"] & sides["test"]
        assert sides["train"] | sides["test"] == {e.source_hash for e in pool.entries}
        assert 0.03 < len(sides["test"]) / len(pool.entries) < 0.2


def test_same_content_under_two_names_is_one_entry_on_one_side(tmp_path):
    for k in range(8):
        box(tmp_path / f"{k}.ply", k)
    pool = object_pool(PoolConfig(folders=(str(tmp_path),), test_fraction=0.4, **NOTHING), ".")
    before = {e.source_hash: split_of(e.source_hash, 0.4) for e in pool.entries}
    other = tmp_path / "other"
    (other / "deep").mkdir(parents=True)
    for k in range(8):
        shutil.copy(tmp_path / f"{k}.ply", other / "deep" / f"z{9 - k}.ply")
        shutil.copy(tmp_path / f"{k}.ply", other / f"a{k}.ply")
    box(other / "new.ply", 99)
    again = object_pool(PoolConfig(folders=("other",), test_fraction=0.4, **NOTHING), tmp_path)
    assert len(again.entries) == 9
    assert {e.source_hash: split_of(e.source_hash, 0.4) for e in again.entries}.items() >= before.items()
    assert [e.source_hash for e in again.entries] == sorted(e.source_hash for e in again.entries)


def test_gltf_with_another_buffer_is_another_mesh(tmp_path):
    hashes = set()
    for k in (1, 2):
        folder = tmp_path / str(k)
        folder.mkdir()
        builder = GltfBuilder()
        builder.node(mesh=builder.mesh(np.eye(3) * k, [[0, 1, 2]]))
        path = builder.gltf(folder)
        hashes.add(object_pool(PoolConfig(folders=(str(folder),), **NOTHING), ".").entries[0].source_hash)
    assert len(hashes) == 2 and (tmp_path / "1" / "scene.gltf").read_text() == path.read_text()


def test_cache_keeps_identity_and_stays_bounded():
    cache = Cache(5 * 8 * 8 * 3)
    pool, other = (
        replace(texture_pool(TexturesConfig(photographs=False, max_size=size), "."), cache=cache) for size in (8, 9)
    )
    first = pool.load(pool.entries[0])
    assert pool.load(pool.entries[0]) is first
    assert other.load(pool.entries[0]).image.shape == (9, 9, 3), "of the same name, and of another pool"
    for entry in pool.entries[:20]:
        pool.load(entry)
    assert len(cache) == 5 and cache.held == cache.limit and pool.load(pool.entries[0]) is not first


def test_loaded_objects_are_normalised():
    folders = (str(shared("data/assets/models_cc0")),)
    pool = object_pool(PoolConfig(folders=folders, keep_materials=False, **NOTHING), ".")
    for entry in pool.entries[:12]:
        (part,) = pool.load(entry).parts
        assert part.mesh.radius == pytest.approx(1, abs=1e-9)
        np.testing.assert_allclose(part.mesh.vertices.min(axis=0), -part.mesh.vertices.max(axis=0), atol=1e-9)
        assert part.mesh.source_hash == entry.source_hash


def test_all_real_models_load_both_ways():
    for keep in (False, True):
        pool = object_pool(
            PoolConfig(folders=(str(shared("data/assets/models_cc0")),), keep_materials=keep, **NOTHING), "."
        )
        assert len(pool.entries) == 81
        for entry in pool.entries:
            asset = pool.load(entry)
            assert asset.parts and all(
                np.isfinite(p.mesh.uvs).all() and np.abs(np.linalg.norm(p.mesh.normals, axis=1) - 1).max() < 1e-5
                for p in asset.parts
            )
            assert len(asset.parts) == 1 or keep


def config_error(make):
    return refusal((ConfigError, AssetError), make)


def test_missing_folders_and_empty_pools(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "empty").mkdir()
    folders = lambda *f, **more: config_error(lambda: object_pool(PoolConfig(folders=f, **NOTHING, **more), tmp_path))
    assert folders("nowhere") == "scene.pool.folders.0: no such folder (got 'nowhere'); expected a folder of meshes"
    assert folders("file") == "scene.pool.folders.0: is not a folder (got 'file'); expected a folder of meshes"
    assert (
        folders("empty")
        == "scene.pool.folders.0: the folder holds no meshes (got 'empty'); expected files of .obj .ply .stl .off .3mf "
        ".glb .gltf"
    )
    box(tmp_path / "empty" / "a.ply")
    assert folders("empty", "nowhere").startswith("scene.pool.folders.1: no such folder")
    pool = object_pool(PoolConfig(**NOTHING), tmp_path)
    assert (
        config_error(lambda: pool.split("train"))
        == "scene.pool: the pool of meshes is empty; expected at least one source of meshes"
    )
    pool = object_pool(PoolConfig(test_fraction=0), tmp_path)
    assert config_error(lambda: pool.split("test")).startswith(
        "scene.pool.test_fraction: none of the 216 meshes falls to split 'test' (got 0.0)"
    )
    assert config_error(lambda: pool.split("val")) == "unknown split (got 'val'); expected train or test"
    assert config_error(
        lambda: texture_pool(TexturesConfig(procedural=False, photographs=False), tmp_path).split("train")
    ) == ("scene.textures: the pool of textures is empty; expected at least one source of textures")
    assert config_error(lambda: texture_pool(TexturesConfig(folders=("empty",)), tmp_path)).startswith(
        "scene.textures.folders.0: the folder holds no images"
    )


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
BILLION_FACES = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1000000000\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n"
)
BILLION_VERTICES = BILLION_FACES.replace("vertex 3\n", "vertex 999999999\n").replace("face 1000000000", "face 1")


def stl_of(faces: int) -> bytes:
    """A file that states so many faces, and ends after ten."""
    return b"binary".ljust(80, b"\0") + struct.pack("<I", faces) + b"\0" * 500


def glb_of(*accessors: int, count: int = 3_000_000_000, virtual: bool = False) -> bytes:
    """A triangle of which these accessors state another count; without a buffer view one is all zeros by the
    specification, and any count costs no byte."""
    builder = triangle_file()
    for accessor in accessors:
        builder.tree["accessors"][accessor]["count"] = count
        if virtual:
            builder.tree["accessors"][accessor].pop("bufferView")
    return builder.glb()


@pytest.mark.parametrize(
    "suffix, content, problem",
    [
        ("obj", "v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n", "line 4: a face has a vertex that is NaN or infinite"),
        ("obj", TRIANGLE, "no faces"),
        ("obj", TRIANGLE + "f 1 2 3\n" * 2001, "too many faces (got 2001); expected at most 1000"),
        ("obj", TRIANGLE + "f 1 2 9\n", ""),
        ("stl", stl_of(1_000_000_000), "too many faces (got 1000000000)"),
        ("stl", stl_of(100), "truncated: 100 faces need 5084 bytes (got 584)"),
        ("ply", BILLION_FACES, "too many faces (got 1000000000)"),
        ("ply", BILLION_VERTICES, "too many vertex elements (got 999999999)"),
        ("glb", glb_of(1), "too many faces (got 1000000000)"),
        ("glb", glb_of(0, 1, virtual=True), "too many faces (got 1000000000)"),
        ("glb", glb_of()[:-20], "truncated"),
        ("glb", glb_of(0, count=30), "reaches outside its buffer"),
        ("ply", "ply nonsense", "no PLY header"),
        ("glb", "glTF", "truncated"),
        ("gltf", "{", "JSON cannot be read"),
        ("gltf", '{"asset": {"version": "1.0"}}', "no glTF 2"),
        ("gltf", '{"asset": {"version": "2.0"}, "nodes": 7}', "no valid glTF"),
        ("obj", "", ""),
        ("stl", "", ""),
    ],
)
def test_bad_meshes_are_named(tmp_path, suffix, content, problem):
    path = tmp_path / f"broken.{suffix}"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())

    def load():
        pool = object_pool(PoolConfig(folders=(str(tmp_path),), max_faces=1000, test_fraction=0, **NOTHING), ".")
        pool.draw(np.random.default_rng(0), "train")

    message = config_error(load)
    assert message.startswith(str(path)) and problem in message


def test_a_file_too_large_is_not_read(tmp_path):
    with open(tmp_path / "big.stl", "wb") as file:
        file.truncate(10_000_000_000)  # sparse
    message = config_error(lambda: object_pool(PoolConfig(folders=(str(tmp_path),), **NOTHING), "."))
    assert message.endswith("big.stl: the mesh file is too large (got '10000 MB'); expected at most 512 MB")


@pytest.mark.parametrize(
    "uri",
    [
        "../secret.bin",
        "/etc/hostname",
        "sub/../../secret.bin",
        "..%2Fsecret.bin",
        "link.bin",
        "https://example.org/a.bin",
        "..\\secret.bin",
    ],
)
def test_gltf_cannot_leave_its_folder(tmp_path, uri):
    folder = tmp_path / "models"
    (folder / "sub").mkdir(parents=True)
    (tmp_path / "secret.bin").write_bytes(b"\0" * 1000)
    (folder / "link.bin").symlink_to(tmp_path / "secret.bin")
    tree = triangle_file(tree={"buffers": [{"byteLength": 100, "uri": uri}]}).tree
    (folder / "a.gltf").write_text(json.dumps(tree))
    message = config_error(lambda: object_pool(PoolConfig(folders=(str(folder),), **NOTHING), "."))
    assert message.startswith(str(folder / "a.gltf")) and ("outside the folder" in message or "on a network" in message)


def test_obj_materials_cannot_leave_their_folder(tmp_path):
    folder = tmp_path / "models"
    folder.mkdir()
    (tmp_path / "secret.mtl").write_text("newmtl a\nKd 1 0 0\n")
    (folder / "link.mtl").symlink_to(tmp_path / "secret.mtl")
    for name in ("../secret.mtl", "link.mtl", str(tmp_path / "secret.mtl")):
        (folder / "a.obj").write_text(f"mtllib {name}\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n")
        pool = object_pool(PoolConfig(folders=(str(folder),), keep_materials=True, **NOTHING), ".")
        found = pool.load(pool.entries[0])
        assert f"'{name}', which lies outside the folder of the pool" in found.omissions[0]
        assert found.parts[0].material.base_color == (1, 1, 1)
        plain = object_pool(PoolConfig(folders=(str(folder),), keep_materials=False, **NOTHING), ".")
        assert plain.load(plain.entries[0]).omissions == ()  # not asked for, not read


def test_obj_materials(tmp_path):
    Image.new("RGB", (4, 4), (10, 200, 30)).save(tmp_path / "t.png")
    (tmp_path / "m.mtl").write_text("newmtl red\nKd 1 0.5 0\nnewmtl tex\nKd 0.2 0.2 0.2\nmap_Kd t.png\n")
    (tmp_path / "a.obj").write_text(
        "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nvn 0 0 1\n"
        "usemtl red\nf 1/1/1 2/2/1 3/3/1\nusemtl tex\nf 2/1/1 4/2/1 3/3/1\n"
    )
    parts = {p.material.texture is not None: p for p in load_asset(tmp_path / "a.obj").parts}
    assert parts[False].material.base_color == pytest.approx((1, 0.214, 0), abs=3e-3)  # Kd is a code, made linear
    assert (parts[True].material.texture.image == (10, 200, 30)).all() and parts[True].material.base_color == (1, 1, 1)
    corner = (parts[False].mesh.vertices == [0, 0, 0]).all(axis=1)
    np.testing.assert_array_equal(parts[False].mesh.uvs[corner], [[0, 1]])  # vt (0, 0) is the bottom left
    assert len(load_asset(tmp_path / "a.obj", keep_materials=False).parts) == 1
    (tmp_path / "b.obj").write_text("mtllib gone.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    plain = load_asset(tmp_path / "b.obj")
    assert (
        plain.omissions == ("b.obj asks for what is not drawn: 'gone.mtl', which is missing",)
        and not plain.has_materials
    )


def test_corrupt_image_in_a_folder_is_named_or_skipped(tmp_path):
    (tmp_path / "bad.jpg").write_bytes(b"\xff\xd8\xff broken")
    only = dict(procedural=False, photographs=False, folders=(str(tmp_path),), test_fraction=0)
    pool, rng, log = texture_pool(TexturesConfig(**only), "."), np.random.default_rng(0), []
    assert config_error(lambda: pool.draw(rng, "train")).startswith(str(tmp_path / "bad.jpg"))
    Image.new("RGB", (8, 8), (200, 100, 50)).save(tmp_path / "good.png")
    pool = texture_pool(TexturesConfig(**only, bad_assets="skip"), ".")
    assert {pool.draw(rng, "train", log).name for _ in range(10)} == {"good.png"}
    assert log and all("bad.jpg" in line for line in log)
    (tmp_path / "good.png").unlink()
    pool = texture_pool(TexturesConfig(**only, bad_assets="skip"), ".")
    assert "50 textures drawn in a row are unusable" in config_error(lambda: pool.draw(rng, "train"))


def test_a_file_too_large_to_look_at_is_named_or_skipped(tmp_path, monkeypatch):
    """Files are read once for their content's hash; what is refused there is as bad an asset
    as what cannot be decoded."""
    (tmp_path / "large.obj").write_text("v 0 0 0\n" * 1000)
    (tmp_path / "small.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    settings = dict(primitives=(), folders=(str(tmp_path),), test_fraction=0)
    monkeypatch.setattr(PoolConfig, "max_file_mb", 0.001)
    assert config_error(lambda: object_pool(PoolConfig(**settings), ".")).startswith(str(tmp_path / "large.obj"))
    assert [e.name for e in object_pool(PoolConfig(**settings, bad_assets="skip"), ".").entries] == ["small.obj"]
