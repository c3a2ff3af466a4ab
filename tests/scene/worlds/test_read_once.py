"""Explicit and file scenes read their meshes and images once a process; what has changed is read again."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from blinkgl.config.camera import CameraConfig
from blinkgl.config.scene import ExplicitSceneConfig, FileSceneConfig
from blinkgl.scene.build import build_scene
from blinkgl.scene.importing import gltf_materials, mesh_files, parts
from blinkgl.scene.reading import RECENT
from tests.scene.gltf_files import textured_file

EYE = {"position": [-4, 0, 0], "look_at": [0, 0, 0]}


@pytest.fixture
def work(monkeypatch):
    """Counts of meshes made, pictures decoded and files parsed."""
    RECENT._kept.clear()
    done: list[str] = []

    def counted(module, name, kind):
        whole = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *a, **k: done.append(kind) or whole(*a, **k))

    counted(parts, "make_mesh", "mesh")
    counted(gltf_materials, "decode_image", "image")
    counted(mesh_files, "_found", "file")
    return done


def write(folder, colour):
    Image.new("RGB", (4, 4), colour).save(folder / "t.png")
    textured_file("t.png").write(folder / "a.glb")
    (folder / "b.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")


def built(config, folder, number):
    return build_scene(config, CameraConfig(width=8, height=6), 0, 10**8, sequence=number, base=folder)


def test_meshes_are_read_once(tmp_path, work):
    write(tmp_path, (200, 0, 0))
    meshes = {"a": {"file": "a.glb"}, "b": {"file": "b.obj"}}
    tree = {"kind": "explicit", "meshes": meshes, "objects": [{"mesh": "a"}, {"mesh": "b"}]}
    explicit = ExplicitSceneConfig.model_validate({**tree, "camera": EYE})
    file = FileSceneConfig.model_validate({"kind": "file", "path": "a.glb", "pose": EYE})
    for config, first in ((explicit, {"mesh": 2, "image": 1, "file": 2}), (file, {"mesh": 1, "image": 1})):
        RECENT._kept.clear()
        work.clear()
        scenes = [built(config, tmp_path, 0)]
        assert {kind: work.count(kind) for kind in dict.fromkeys(work)} == first
        work.clear()
        # Another camera, as where key frames are drawn for each sequence.
        moved = {"camera" if config is explicit else "pose": {**EYE, "position": [-5, 1, 0]}}
        other = type(config).model_validate({**config.model_dump(exclude_unset=True), **moved})
        scenes += [built(config, tmp_path, 1), built(other, tmp_path, 2)]
        assert not work
        for scene in scenes[1:]:
            for ours, theirs in zip(scene.objects, scenes[0].objects, strict=True):
                np.testing.assert_array_equal(ours.parts[0].mesh.vertices, theirs.parts[0].mesh.vertices)
            assert scene.log == scenes[0].log and scene.omissions == scenes[0].omissions
        write(tmp_path, (0, 200, 0))
        image = built(config, tmp_path, 3).objects[0].parts[0].material.texture.image
        assert tuple(image[0, 0]) == (0, 200, 0) and "image" in work
        write(tmp_path, (200, 0, 0))
