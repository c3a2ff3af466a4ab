"""Maps of explicit scenes' materials: normals, gloss, emission, holes, from files and from arrays; what is refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

import blinkgl
from blinkgl import ConfigError
from blinkgl.config.problems import validate
from blinkgl.config.scene import ExplicitSceneConfig
from blinkgl.errors import BlinkGLError
from blinkgl.scene.build import build_scene, check_assets
from tests.refusals import refusal

NORMALS = np.full((8, 8, 3), (128, 128, 255), np.uint8)
NORMALS[:, 4:] = (255, 128, 128)
NUMBERS = np.zeros((8, 8, 3), np.uint8)
NUMBERS[..., 1] = np.arange(0, 256, 32)
HOLES = np.zeros((8, 8), np.uint8)
HOLES[2:6] = 255
MAPS = {"normal_map": NORMALS, "metallic_roughness_map": NUMBERS, "emission_map": NORMALS, "mask": HOLES}
MORE = {"normal_scale": 0.5, "emission": [2.0, 1.0, 0.5], "metallic": 0.5, "cutoff": 0.4}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("maps")
    for name, image in MAPS.items():
        cv2.imwrite(str(path / f"{name}.png"), image[..., ::-1] if image.ndim == 3 else image)
    opaque = np.full((8, 8, 4), 90, np.uint8)
    opaque[..., 3] = HOLES
    cv2.imwrite(str(path / "opacity.png"), opaque)
    cv2.imwrite(str(path / "black.png"), 0 * HOLES)
    cv2.imwrite(str(path / "bright.hdr"), NORMALS.astype(np.float32))
    return path


def config(**material):
    tree = {
        "kind": "explicit",
        "meshes": {"ball": {"primitive": "sphere"}},
        "materials": {"m": material},
        "objects": [{"mesh": "ball", "material": "m", "position": [0, 3, 0]}],
        "camera": {"look_at": [0, 3, 0]},
    }
    return validate(ExplicitSceneConfig, tree)


def material_of(folder, **material):
    one = config(**material)
    check_assets(one, folder)
    from blinkgl.config.camera import CameraConfig

    (part,) = build_scene(one, CameraConfig(width=16, height=12), 0, 1000, base=folder).objects[0].parts
    return part.material


def test_maps_are_what_the_files_hold(folder):
    made = material_of(folder, **{key: f"{key}.png" for key in MAPS}, **MORE)
    np.testing.assert_array_equal(made.bumps.texture.image, NORMALS)
    np.testing.assert_array_equal(made.gloss.map.texture.image, NUMBERS)
    np.testing.assert_array_equal(made.emission_map.texture.image, NORMALS)
    np.testing.assert_array_equal(made.mask.alpha, HOLES)
    assert (made.bump_scale, made.emission, made.mask.cutoff, made.gloss.metallic) == (0.5, (2.0, 1.0, 0.5), 0.4, 0.5)


def test_a_mask_is_the_opacity_of_a_picture_that_has_one(folder):
    np.testing.assert_array_equal(material_of(folder, mask="opacity.png").mask.alpha, HOLES)
    assert material_of(folder, mask="normal_map.png", cutoff=0.3).mask is None  # all of it is there


@pytest.mark.parametrize(
    "material, words",
    [
        ({"normal_map": "no.png"}, r"scene\.materials\.m\.normal_map: no such file .got 'no\.png'.; expected an image"),
        (
            {"normal_map": "bright.hdr"},
            r"materials\.m\.normal_map: bright\.hdr: a map of numbers is a high-dynamic-range image",
        ),
        (
            {"mask": "black.png"},
            r"materials\.m\.cutoff: the mask removes the whole surface .got 0\.5.; expected a mask",
        ),
        ({"mask": "mask.png", "cutoff": 0}, r"materials\.m\.cutoff: too small"),
        ({"emission_map": "mask.png"}, r"materials\.m\.emission: emission_map has no effect"),
        (
            {"normal_map": "mask.png", "unlit": True},
            r"materials\.m\.normal_map: this map has no effect on an unlit surface",
        ),
        ({"normal_map": "mask.png", "normal_scale": float("inf")}, r"materials\.m\.normal_scale: not a finite number"),
    ],
)
def test_what_is_wrong_is_one_line_with_its_key(folder, material, words):
    refusal(BlinkGLError, material_of, folder, match=words, **material)


def test_arrays_draw_what_files_draw(folder):
    """In Python: the same picture from arrays and from files, and another one than without."""

    def picture(**maps):
        ball = blinkgl.Primitive("sphere", pose=(2, 0, 0), material=blinkgl.Material(**maps, **MORE))
        camera = blinkgl.Camera(32, 24, pose=blinkgl.look_at((0, 0, 0), (2, 0, 0)))
        return blinkgl.render_frame(blinkgl.Scene(camera, [ball]), 0).images

    arrays = picture(**MAPS)
    np.testing.assert_array_equal(arrays, picture(**{key: str(folder / f"{key}.png") for key in MAPS}))
    assert all(
        not np.array_equal(arrays, picture(**{other: map_ for other, map_ in MAPS.items() if other != key}))
        for key in MAPS
    )


def test_arrays_that_are_no_maps_are_refused():
    for key, wrong in (("mask", NORMALS), ("normal_map", HOLES), ("normal_map", NORMALS.astype(np.float32))):
        refusal(ConfigError, blinkgl.Material, match=rf"Material\.{key}", **{key: wrong})
