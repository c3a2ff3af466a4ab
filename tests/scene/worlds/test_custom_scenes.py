"""Scenes that live: those of configs/scenes, what a `way:` does, and figures, flags and fish in random worlds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from blinkgl.config.camera import CameraConfig
from blinkgl.config.problems import validate
from blinkgl.config.run import load_run
from blinkgl.config.scene import ExplicitSceneConfig, RandomSceneConfig
from blinkgl.errors import ConfigError
from blinkgl.scene.build import build_scene, sequence_scene
from tests.refusals import refusal
from tests.scene.faces import points_at

CONFIGS = Path(__file__).parents[3] / "configs"
NAMES = ("dancers", "crossing", "flags", "aquarium", "falling_dice")
CAMERA = CameraConfig(width=64, height=48)
SECOND = 10**9


# ---- configs/scenes --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=NAMES)
def pair(request):
    """(name, two scenes of it)."""
    if request.param == "falling_dice":
        pytest.importorskip("mujoco")
    template = load_run(CONFIGS / f"scenes/{request.param}.yaml", ["camera.width=64", "camera.height=48"])
    return request.param, [sequence_scene(template.sequence(index), index) for index in (0, 1)]


def test_blinkflow_has_them_as_its_custom_scenes():
    for recipe in ("blinkflow", "blinkflow_mini"):
        text = (CONFIGS / f"{recipe}.yaml").read_text(encoding="utf-8")
        used = [name for name in NAMES if f"scenes/{name}.yaml" in text]
        assert used == list(NAMES) if recipe == "blinkflow" else set(used) <= set(NAMES)


# ---- way: ------------------------------------------------------------------------------------------------------------


def explicit(**thing):
    tree = {
        "kind": "explicit",
        "meshes": {
            "ann": {"primitive": "figure", "parameters": {"clip": "walk"}},
            "ben": {"primitive": "figure", "parameters": {"clip": "dance"}},
            "cod": {"primitive": "fish"},
            "box": {"primitive": "cuboid"},
        },
        "objects": [thing],
        "camera": {"position": [-5, 0, 1]},
    }
    return build_scene(validate(ExplicitSceneConfig, tree, where="scene"), CAMERA, 0, SECOND, base=Path())


LINE = [[0, 0, 0], [2, 0, 0], [4, 0, 0]]


@pytest.mark.parametrize("mesh, way, speed", [
    ("ann", {}, None), ("ann", {"speed": 0.3}, 0.3), ("cod", {}, None), ("box", {}, 1.0), ("ben", {}, 1.0),
])  # fmt: skip
def test_a_way_is_gone_along_as_fast_as_steps_take_it(mesh, way, speed):
    """null: a figure's steps, a fish's strokes, 1 m/s of what has no gait."""
    (thing,) = explicit(mesh=mesh, way={"points": LINE, **way}).objects
    if speed is None:
        speed = thing.parts[0].mesh.deformer.speed
        assert speed > 0.1
    for t in (0, SECOND // 2, SECOND):
        T = thing.path.pose(t)
        np.testing.assert_allclose(T[:3, 3], [speed * t / SECOND, 0, 0], atol=1e-6)
        np.testing.assert_allclose(T[:3, :3], np.eye(3), atol=1e-9)


def test_a_way_begins_where_it_is_told_and_closes():
    (half,) = explicit(mesh="box", way={"points": LINE, "start": 0.5}).objects
    np.testing.assert_allclose(half.path.pose(0)[:3, 3], [2, 0, 0], atol=1e-6)
    square = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    (round_,) = explicit(mesh="box", scale=2, way={"points": square, "closed": True, "speed": 2.5}).objects
    assert np.linalg.norm(round_.path.pose(SECOND)[:3, 3] - [0.5, 0.5, 0]) < 1  # once round is about 3.3 m


@pytest.mark.parametrize("keys, said", [
    ({"way": {"points": LINE}, "position": [1, 0, 0]}, "a way, a fixed pose or keyframes, not several"),
    ({"way": {"points": LINE}, "keyframes": [{"time": 0}, {"time": 1}]}, "a way, a fixed pose or keyframes"),
    ({"way": {"points": [[0, 0, 0]]}}, r"way.points: a way needs at least 2 points \(got 1\)"),
    ({"way": {"points": LINE[:2], "closed": True}}, "a way needs at least 3 points"),
    ({"way": {"points": [[0, 0, 0], [0, 0, 0], [1, 0, 0]]}}, "way.points.0: must differ from the next point"),
    ({"way": {"points": LINE, "speed": 0}}, "way.speed"),
    ({"way": {"points": LINE, "start": 1.5}}, "way.start"),
    ({"way": {"points": LINE, "pace": 2}}, "way.pace"),
    ({"way": 3}, "way: not a table"),
])  # fmt: skip
def test_a_way_that_is_none_is_refused_in_one_line(keys, said):
    refusal(ConfigError, explicit, match=said, mesh="ann", **keys)


# ---- random worlds ---------------------------------------------------------------------------------------------------


def world(seed=0, **tree):
    tree = {
        "kind": "random",
        "pool": {"primitives": ["figure", "flag", "fish"], "variants": 6, "test_fraction": 0, "keep_materials": True},
        "textures": {"procedural": ["checks"], "photographs": False, "max_size": 32, "test_fraction": 0},
        "objects": {"count": 6},
        "region": {"width": 20, "height": 6},
        **tree,
    }
    return build_scene(
        validate(RandomSceneConfig, tree, where="scene"), CAMERA, 0, SECOND, base=Path(), seed=seed, sequence=0
    )


def test_living_things_enter_random_worlds():
    """Figures upright on the ground, in coats of their own, going as fast as they step or standing where they dance;
    flags and fish level in the air."""
    things = [o for seed in (1, 2) for o in world(seed).objects if o.category == "object"]
    kinds = {o.name.partition("-")[0] for o in things}
    assert kinds == {"figure", "flag", "fish"} and all(o.deforms for o in things)
    went = 0
    for o in things:
        mesh, T, later = o.parts[0].mesh, o.path.pose(0), o.path.pose(SECOND)
        assert o.parts[0].material.texture.image.ndim == 3
        if o.name.startswith("figure"):
            np.testing.assert_allclose(T[:3, 2], [0, 0, 1], atol=1e-9)
            np.testing.assert_allclose(later[2, 3], T[2, 3], atol=1e-9)
            low = min(points_at(o, t)[:, 2].min() for t in range(0, SECOND, SECOND // 8))
            assert -0.03 * mesh.radius < low < 0.1 * mesh.radius
            speed = np.linalg.norm(o.path.derivative(SECOND // 10)[:3, 3])
            assert speed == 0 or speed == pytest.approx(mesh.deformer.speed, rel=0.02)
            went += speed > 0
        elif o.name.startswith("flag"):
            np.testing.assert_allclose(T[:3, 2], [0, 0, 1], atol=1e-9)
        else:
            assert abs(T[2, 1]) < 1e-9  # no fish lies on its side
    assert went


def test_what_goes_by_itself_is_not_thrown():
    pytest.importorskip("mujoco")
    pool = {"primitives": ["cuboid", "figure"], "variants": 3, "test_fraction": 0}
    scene = world(2, pool=pool, physics={"share": 1.0})
    falls = [o.name for o in scene.objects if o.category == "object" and type(o.path).__name__ == "HermitePath"]
    assert falls and all(name.startswith("cuboid") for name in falls)
    assert scene.dynamics.bodies == len(falls)
