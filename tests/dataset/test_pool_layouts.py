"""Pools in the layouts of other people's data sets: everything that is read for an asset is its identity, textures lie
where those data sets keep them, and a run repeats byte for byte."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from blinkgl.cli import run
from blinkgl.config.scene import PoolConfig
from blinkgl.errors import AssetError
from blinkgl.scene.importing.mesh_files import identity_of, load_asset
from blinkgl.scene.worlds.pool import object_pool
from tests.scene.gltf_files import GltfBuilder, triangle
from tests.tiny_recipe import TINY

RED, BLUE, GREEN = (220, 20, 20), (20, 20, 220), (10, 240, 10)
NOTHING = {"primitives": (), "test_fraction": 0}


def picture(path: Path, colour=RED) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (8, 8), colour).save(path)


def box(path: Path, texture: str | None, size=(1.0, 1.0, 1.0), mtl: str = "m.mtl") -> None:
    """A textured box as OBJ and MTL; the texture's file is the caller's."""
    points = [(x * size[0], y * size[1], z * size[2]) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [f"mtllib {mtl}", *(f"v {x} {y} {z}" for x, y, z in points), "vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1"]
    faces = ["f " + " ".join(f"{v + 1}/{k + 1}" for k, v in enumerate(quad)) for quad in quads]
    path.write_text("\n".join([*lines, "usemtl m", *faces, ""]))
    if texture is not None:
        (path.parent / mtl).write_text(f"newmtl m\nKd 1 1 1\nmap_Kd {texture}\n")


def textured_gltf(folder: Path, image: str, buffer: str | None) -> Path:
    builder = GltfBuilder()
    surface = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0}}
    builder.tree.update(materials=[surface], images=[{"uri": image}], textures=[{"source": 0}])
    builder.node(mesh=triangle(builder, uvs=[(0, 0), (1, 0), (0, 1)], material=0))
    folder.mkdir(parents=True, exist_ok=True)
    if buffer is None:
        (folder / "scene.glb").write_bytes(builder.glb())
        return folder / "scene.glb"
    return builder.gltf(folder, uri=buffer)


def shapenet(root: Path) -> None:
    for k, size in enumerate(((1, 1, 1), (1, 2, 1))):
        box(root / f"0295/{k}/models/model_normalized.obj", "../images/texture0.jpg", size)
        picture(root / f"0295/{k}/images/texture0.jpg")


def partnet(root: Path) -> None:
    box(root / "44781/textured_objs/original-1.obj", "../images/texture_1.jpg", mtl="original-1.mtl")
    picture(root / "44781/images/texture_1.jpg")


def scanned_objects(root: Path) -> None:
    box(root / "Shoe/meshes/model.obj", "texture.png")
    picture(root / "Shoe/materials/textures/texture.png")
    box(root / "Cup/meshes/model.obj", "../materials/textures/texture.png", (1, 1, 2))
    picture(root / "Cup/materials/textures/texture.png")


def kenney(root: Path) -> None:
    for k in range(3):
        box(root / f"Models/OBJ format/part{k}.obj", "Textures/colormap.png", (1, 1 + k, 1), f"part{k}.mtl")
    picture(root / "Models/OBJ format/Textures/colormap.png")


def ycb(root: Path) -> None:
    box(root / "002_master_chef_can/google_16k/textured.obj", "texture_map.png", mtl="textured.mtl")
    file = root / "002_master_chef_can/google_16k/textured.obj"
    file.write_text(file.read_text().replace("usemtl m\n", ""))
    picture(file.with_name("texture_map.png"))


def colour_variants(root: Path) -> None:
    for name, colour in (("red", RED), ("blue", BLUE)):
        for k, size in enumerate(((1, 1, 1), (1, 2, 1))):
            box(root / f"{name}/car{k}/car.obj", "body.png", size)
            picture(root / f"{name}/car{k}/body.png", colour)


def objaverse(root: Path) -> None:
    textured_gltf(root / "glbs/000-001", "skin.png", None)
    picture(root / "glbs/000-001/skin.png")


def poly_haven(root: Path) -> None:
    textured_gltf(root / "barrel", "textures/barrel_diff.png", "barrel.bin")
    picture(root / "barrel/textures/barrel_diff.png")


def meshlab_scans(root: Path) -> None:
    head = "ply\nformat ascii 1.0\ncomment TextureFile Scan.PNG\nelement vertex 3\nproperty float x\nproperty float y\n"
    head += "property float z\nproperty float s\nproperty float t\nelement face 1\n"
    root.mkdir(parents=True, exist_ok=True)
    text = head + "property list uchar int vertex_indices\nend_header\n0 0 0 0 0\n1 0 0 1 0\n0 1 1 0 1\n3 0 1 2\n"
    (root / "scan.ply").write_text(text)
    picture(root / "scan.png")


def linked(root: Path) -> None:
    box(root.parent / "elsewhere/chair/chair.obj", "chair.png")
    picture(root.parent / "elsewhere/chair/chair.png")
    root.mkdir(parents=True, exist_ok=True)
    (root / "chair").symlink_to(root.parent / "elsewhere/chair")
    (root / "again").symlink_to(root)  # a circle


LAYOUTS = [
    shapenet, partnet, scanned_objects, kenney, ycb, colour_variants, objaverse, poly_haven, meshlab_scans, linked,
]  # fmt: skip


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.__name__)
def test_every_file_that_is_read_is_the_identity(tmp_path, monkeypatch, layout):
    """What the loader opens is recorded: no file but the mesh and those of its identity. Each of those, changed or
    gone, is another identity, and the pool names it; only buffers are part of the shape, which decides the split."""
    layout(tmp_path / "pool")
    pool = object_pool(PoolConfig(folders=(str(tmp_path / "pool"),), **NOTHING), ".")
    opened: set[Path] = set()
    whole = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda self: opened.add(self) or whole(self))
    for entry in pool.entries:
        opened.clear()
        found = load_asset(entry.file, border=entry.border)
        read = {path.resolve() for path in opened}
        data = entry.file.read_bytes()
        identity = identity_of(entry.file, data, entry.border)
        beside = {
            (entry.file.parent / name).resolve() for name, digest in identity.files.items() if digest != "missing"
        }
        assert read == {entry.file.resolve(), *beside}
        textured = [part.material.texture for part in found.parts if part.material.texture is not None]
        if layout is not scanned_objects or entry.name.startswith("Cup"):
            assert textured and not found.omissions, found.omissions
        else:  # the texture lies beside "meshes", which nothing in the files says
            assert not textured and "'texture.png', which is missing" in found.omissions[0]
        for file in sorted(beside):
            kept = whole(file)
            file.write_bytes(kept + b" ")
            other = identity_of(entry.file, data, entry.border)
            assert other.whole != identity.whole
            assert (other.shape == identity.shape) == (file.suffix != ".bin")
            with pytest.raises(AssetError, match="has changed while it was in use") as error:
                pool.load_entry(entry)
            assert Path(error.value.where).resolve() == file
            if file.suffix != ".bin":
                file.unlink()
                assert identity_of(entry.file, data, entry.border).whole not in (identity.whole, other.whole)
            file.write_bytes(kept)


def recipe(folder: Path, **pool) -> Path:
    scene = {**TINY["scene"], "kind": "random", "objects": {"count": 3}}
    scene["pool"] = {"primitives": [], "folders": ["pool"], "test_fraction": 0, **pool}
    scene["textures"] = {**scene["textures"], "test_fraction": 0}
    tree = {**TINY, "scene": scene, "labels": {"flow": ["forward"]}, "output": {"sequences": 4}}
    (folder / "recipe.yaml").write_text(yaml.safe_dump(tree))
    return folder / "recipe.yaml"


def files_of(out: Path) -> dict[str, bytes]:
    """Everything of the sequences but manifests, which name times."""
    below = sorted(p for p in (out / "train").rglob("*") if p.is_file() and p.name != "manifest.json")
    return {str(p.relative_to(out)): p.read_bytes() for p in below}


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.__name__)
def test_a_pool_repeats_byte_for_byte(tmp_path, capsys, layout):
    """A sequence is its recipe, its number and its files, whatever its process made before."""
    layout(tmp_path / "pool")
    path, out = recipe(tmp_path), tmp_path / "out"
    assert run(["generate", str(path), "--out", str(out), "--quiet"]) == 0, capsys.readouterr().err
    first = files_of(out)
    for name in ("sequence_000001", "sequence_000002", "sequence_000003"):
        shutil.rmtree(out / "train" / name)
    object_pool.__globals__["RECENT"]._kept.clear()
    assert run(["generate", str(path), "--out", str(out), "--resume", "--quiet"]) == 0, capsys.readouterr().err
    assert files_of(out) == first
    assert run(["verify", str(out), "--deep"]) == 0, capsys.readouterr().out
    drawn = json.loads((out / "train/sequence_000000/manifest.json").read_text())
    textures = [part["texture"] for one in drawn["objects"] for part in one["parts"]]
    assert len(textures) > 2, drawn


def test_a_texture_that_changed_stops_the_run_and_is_named(tmp_path, capsys):
    """In a pool, beside a mesh of an explicit scene, and beside a scene file."""
    colour_variants(tmp_path / "pool")
    box(tmp_path / "mine/chair.obj", "../looks/chair.png")
    picture(tmp_path / "looks/chair.png")
    textured_gltf(tmp_path / "room", "../looks/room.png", None)
    picture(tmp_path / "looks/room.png")
    explicit = {"kind": "explicit", "meshes": {"chair": {"file": "mine/chair.obj"}}, "objects": [{"mesh": "chair"}]}
    explicit["camera"] = {"position": [-4, 0, 0], "look_at": [0, 0, 0]}
    scenes = {
        "pool/red/car0/body.png": None,
        "mine/../looks/chair.png": explicit,
        "room/../looks/room.png": {"kind": "file", "path": "room/scene.glb", "pose": explicit["camera"]},
    }
    for number, (name, scene) in enumerate(scenes.items()):
        path, out = recipe(tmp_path), tmp_path / f"out{number}"
        if scene is not None:
            tree = yaml.safe_load(path.read_text())
            path.write_text(yaml.safe_dump({**tree, "scene": scene, "output": {"sequences": 2}}))
        assert run(["generate", str(path), "--out", str(out), "--quiet"]) == 0, capsys.readouterr().err
        shutil.rmtree(out / "train" / "sequence_000001")
        picture(tmp_path / name, GREEN)
        capsys.readouterr()
        assert run(["generate", str(path), "--out", str(out), "--resume", "--quiet"]) == 2
        error = capsys.readouterr().err
        assert "the pools have changed since the run began" in error and error.count("\n") == 1
        assert os.path.normpath(name).replace("pool/", "") in error and "(changed)" in error


def test_equal_meshes_of_other_colours_are_two_entries_of_one_split(tmp_path):
    """Colour variants in one folder: each is drawn, in its own colour, and all are on one side of the split; without
    their looks they are one."""
    colour_variants(tmp_path)
    pool = object_pool(PoolConfig(folders=(str(tmp_path),), **NOTHING), ".")
    shapes = {entry.shape for entry in pool.entries}
    assert len(pool.entries) == 4 and len(shapes) == 2
    first = min(int(shape[:13], 16) for shape in shapes) / 16**13  # between the two: one is in either part
    apart = object_pool(PoolConfig(folders=(str(tmp_path),), primitives=(), test_fraction=first + 1e-9), ".")
    sides = [[e.shape for part in apart.split(s).values() for e in part] for s in ("train", "test")]
    assert [len(side) for side in sides] == [2, 2] and {*sides[0]}.isdisjoint(sides[1])
    for entry in (*pool.entries, *reversed(pool.entries)):  # in any order
        image = pool.load(entry).parts[0].material.texture.image
        assert tuple(image[0, 0]) == (RED if entry.name.startswith("red") else BLUE)
    white = object_pool(PoolConfig(folders=(str(tmp_path),), keep_materials=False, **NOTHING), ".")
    assert len(white.entries) == 2


def test_hidden_files_and_folders_are_left_out_and_counted(tmp_path):
    for name in ("a.obj", ".b.obj", ".git/c.obj", "sub/.d/e.obj", "sub/f.obj"):
        box(tmp_path / name, None)
    box(tmp_path.parent / f"{tmp_path.name}-away/g.obj", None, (1, 1, 3))
    (tmp_path / "link.obj").symlink_to(tmp_path.parent / f"{tmp_path.name}-away/g.obj")
    pool = object_pool(PoolConfig(folders=(str(tmp_path),), **NOTHING), ".")
    assert sorted(entry.name for entry in pool.entries) == ["a.obj", "link.obj"]  # f.obj is equal to a.obj
    (note,) = pool.notes
    assert note == "scene.pool.folders.0: 3 hidden files or folders are left out (.b.obj, .d, .git)"


def test_own_looks_are_kept_where_a_file_has_them(tmp_path):
    """auto: a texture, colours of vertices, two colours; one plain grey is what exporters write. The log says which."""
    box(tmp_path / "textured.obj", "t.png", mtl="t.mtl")
    picture(tmp_path / "t.png")
    square = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
    (tmp_path / "g.mtl").write_text("newmtl m\nKd 0.8 0.8 0.8\nnewmtl n\nKd 0.1 0.1 0.1\nnewmtl red\nKd 0.8 0 0\n")
    texts = {
        "grey": "mtllib g.mtl\n" + square + "usemtl m\nf 1 2 3 4\n",
        "greys": "mtllib g.mtl\n" + square + "usemtl m\nf 1 2 3\nusemtl n\nf 1 3 4\n",
        "red": "mtllib g.mtl\n" + square + "usemtl red\nf 1 2 3 4\n",
        "bare": square + "f 4 3 2 1\n",
        "tinted": "v 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 0 1 0 0 0 1\nf 1 2 3\n",
    }
    for name, text in texts.items():
        (tmp_path / f"{name}.obj").write_text(text)
    looking = {"auto": {"textured", "greys", "red", "tinted"}, True: {*texts, "textured"} - {"bare"}, False: set()}
    for keep, expected in looking.items():
        pool = object_pool(PoolConfig(folders=(str(tmp_path),), keep_materials=keep, **NOTHING), ".")
        assets = [pool.load(entry) for entry in pool.entries]
        kept = {asset.name for asset in assets if asset.has_materials}
        assert kept == expected
        said = {line for asset in assets for line in asset.log if "keep_materials" in line}
        if keep == "auto":
            assert (
                "bare: its look is one of the world, since it has none of its own (scene.pool.keep_materials: auto)"
                in said
            )
            assert "red: its look is its own (scene.pool.keep_materials: auto)" in said and len(said) == 6
        else:
            assert not said
    coats = object_pool(PoolConfig(primitives=("figure",), variants=1, test_fraction=0), ".")
    assert not coats.load(coats.entries[0]).has_materials  # a recipe's figures keep the world's textures


@pytest.mark.parametrize(
    "name, content, problem",
    [
        ("a.glb", b"glTF\2\0\0\0", "the file is truncated"),
        ("a.gltf", b"{", "its JSON cannot be read"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement face 99999999\nend_header\n", "too many faces"),
        ("a.obj", b"v 0 0 0\n", "the file has no faces"),
        ("a.off", b"OFF\n3 1000000 0\n", "too many faces"),
        ("a.stl", b"x" * 80 + b"\1\0\0\0", "truncated"),
        ("a.3mf", b"PK", "not a zip file"),
    ],
)
def test_a_listing_names_bad_files_before_anything_is_drawn(tmp_path, name, content, problem):
    box(tmp_path / "good.obj", None)
    (tmp_path / name).write_bytes(content)
    with pytest.raises(AssetError) as error:
        object_pool(PoolConfig(folders=(str(tmp_path),), **NOTHING), ".")
    assert str(tmp_path / name) in str(error.value) and problem in str(error.value) and "\n" not in str(error.value)
    pool = object_pool(PoolConfig(folders=(str(tmp_path),), bad_assets="skip", **NOTHING), ".")
    assert [entry.name for entry in pool.entries] == ["good.obj"]
    assert pool.notes[0].startswith(f"scene.pool.folders.0: 1 unusable files are left out ({name}: ")
    assert np.isfinite(pool.load(pool.entries[0]).parts[0].mesh.vertices).all()
