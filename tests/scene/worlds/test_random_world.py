"""Random worlds: determinism, placement, splits, look, light; and configuration errors by message."""

from dataclasses import replace

import numpy as np
import pytest

from blinkgl.config.camera import CameraConfig
from blinkgl.config.lights import LightConfig
from blinkgl.config.problems import validate
from blinkgl.config.scene import (
    ExplicitSceneConfig,
    ObjectsConfig,
    PoolConfig,
    RandomSceneConfig,
    RegionConfig,
    SkyConfig,
    TexturesConfig,
)
from blinkgl.errors import AssetError, ConfigError
from blinkgl.scene.build import build_scene, check_assets
from blinkgl.scene.worlds.random_world import pools
from tests.refusals import refusal
from tests.scene.faces import outwards, points_at
from tests.shared_data import shared

CAMERA = CameraConfig(width=96, height=72)
T1 = 400_000_000
SMALL = TexturesConfig(max_size=32, variants=10)


def config(**changes) -> RandomSceneConfig:
    return RandomSceneConfig(**{"textures": SMALL, "objects": ObjectsConfig(count=10), **changes})


def build(settings, sequence=0, seed=0, split="train", base="."):
    return build_scene(settings, CAMERA, 0, T1, split=split, seed=seed, sequence=sequence, base=base)


def fingerprint(scene) -> bytes:
    times = np.array([0, 123_456_789, T1])
    chunks = [
        scene.camera_path.poses(times).tobytes(),
        repr((scene.light, scene.log, scene.camera.K.tolist())).encode(),
    ]
    for o in scene.objects:
        chunks += [o.name.encode(), bytes([o.instance_id]), o.path.poses(times).tobytes()]
        for p in o.parts:
            m = p.mesh
            chunks += [
                m.vertices.tobytes(),
                m.faces.tobytes(),
                m.normals.tobytes(),
                m.uvs.tobytes(),
                repr(replace(p.material, texture=None)).encode(),
            ]
            chunks += [p.material.texture.image.tobytes()] if p.material.texture else []
    return b"".join(chunks)


def test_same_seed_same_arrays_whatever_was_built_before():
    first = fingerprint(build(config(), sequence=3))
    pools.__globals__["_object_pool"].cache_clear()
    pools.__globals__["_texture_pool"].cache_clear()
    assert fingerprint(build(config(), sequence=3)) == first
    build(config(), sequence=1)
    assert fingerprint(build(config(), sequence=3)) == first
    others = [
        fingerprint(build(config(), **k))
        for k in (dict(sequence=4), dict(sequence=3, seed=1), dict(sequence=3, split="test"))
    ]
    assert first not in others and len(set(others)) == 3


@pytest.fixture(scope="module")
def worlds():
    return [build(config(), sequence=k) for k in range(8)]


def things(scene):
    return [o for o in scene.objects if o.category == "object"]


def test_resting_objects_touch_the_ground_and_nothing_is_below(worlds):
    resting = flying = 0
    for scene in worlds:
        for o in things(scene):
            lowest = points_at(o)[:, 2].min()
            assert lowest > -1e-9
            resting += abs(lowest) < 1e-9
            flying += lowest > 0.01
    assert resting + flying == sum(len(things(s)) for s in worlds)
    assert 0.3 < resting / (resting + flying) < 0.7


def test_bounding_spheres_are_apart_at_the_start(worlds):
    for scene in worlds:
        centres = np.array([o.path.pose(0)[:3, 3] for o in things(scene)] + [scene.camera_path.pose(0)[:3, 3]])
        radii = np.array([o.radius for o in things(scene)] + [CAMERA.model.near_corner])
        gap = np.linalg.norm(centres[:, None] - centres, axis=2) - radii[:, None] - radii
        assert gap[~np.eye(len(gap), dtype=bool)].min() > 0


def test_most_objects_are_in_view_at_many_distances(worlds):
    seen, distances, total = 0, [], 0
    for scene in worlds:
        T = np.linalg.inv(scene.camera_path.pose(0))
        for o in things(scene):
            X = T[:3, :3] @ o.path.pose(0)[:3, 3] + T[:3, 3]
            total += 1
            if X[2] > 0:
                x, y = scene.camera.fx * X[0] / X[2] + scene.camera.cx, scene.camera.fy * X[1] / X[2] + scene.camera.cy
                margin = scene.camera.fx * o.radius / X[2]
                if -margin < x < CAMERA.width + margin and -margin < y < CAMERA.height + margin:
                    seen += 1
                    distances.append(np.linalg.norm(X))
    assert seen / total > 0.7 and total >= 70
    assert min(distances) < 4 and max(distances) > 12


def test_structure(worlds):
    for scene in worlds:
        ids = [o.instance_id for o in scene.objects]
        assert ids[0] == 1 and len(set(ids)) == len(ids) and len({o.name for o in scene.objects}) == len(ids)
        sky, ground = scene.objects[:2]
        assert (sky.category, ground.category) == ("sky", "ground") and sky.path.is_static and ground.path.is_static
        assert all(p.material.unlit for p in sky.parts) and len(sky.parts) == 6
        for p in sky.parts:  # faces look inwards, cells are small
            v = p.mesh.vertices[p.mesh.faces]
            assert outwards(p.mesh.vertices, p.mesh.faces).max() < 0
            assert np.linalg.norm(v[:, 1] - v[:, 0], axis=1).max() < 1.5 * SkyConfig().size / SkyConfig().subdivisions
        assert np.ptp(sky.parts[0].mesh.vertices) == pytest.approx(100)
        for o in scene.objects:
            assert all(p.mesh.closed or o.category != "object" for p in o.parts)
            for p in o.parts:
                top = np.asarray(p.material.base_color) * (
                    scene.light.sun + scene.light.sky if not p.material.unlit else 1
                )
                assert p.material.texture is not None and top.max() <= 1.5
        assert np.linalg.norm(scene.light.sun_direction) == pytest.approx(1) and scene.light.sun_direction[2] > 0.4


def test_options():
    bare = build(config(sky=None, ground=None, objects=ObjectsConfig(count=6, flying=0.0)))
    assert {o.category for o in bare.objects} == {"object"}
    unlit = build(config(light=LightConfig(unlit=True)))
    assert all(p.material.unlit for o in unlit.objects for p in o.parts)
    assert len(things(build(config(objects=ObjectsConfig(count=0))))) == 0
    standing = build(config())
    assert min(points_at(o)[:, 2].min() for o in things(standing)) == pytest.approx(0, abs=1e-9)
    assert 1 <= standing.camera_path.pose(0)[2, 3] <= 3.5


def test_crowded_worlds_leave_objects_out_and_say_so():
    scene = build(config(objects=ObjectsConfig(count=60, size=(3.0, 4.0)), region=RegionConfig(width=10, height=5)))
    missing = 60 - len(things(scene))
    assert missing > 0 and sum("left out" in line for line in scene.log) == missing


def test_splits_share_neither_meshes_nor_textures():
    used = {}
    for split in ("train", "test"):
        scenes = [
            build(
                config(pool=PoolConfig(test_fraction=0.5), textures=TexturesConfig(max_size=16, test_fraction=0.5)),
                k,
                split=split,
            )
            for k in range(4)
        ]
        used[split] = (
            {p.mesh.source_hash for s in scenes for o in things(s) for p in o.parts},
            {p.material.texture.source_hash for s in scenes for o in s.objects for p in o.parts},
        )
    for train, test in zip(used["train"], used["test"]):
        assert train and test and not train & test


def test_real_assets_with_their_materials_and_panorama_sky():
    base = shared("data/assets")
    settings = config(
        pool=PoolConfig(primitives=(), folders=("models_cc0",), keep_materials=True),
        textures=TexturesConfig(max_size=64, folders=("textures_cc0",)),
        sky=SkyConfig(panoramas=("hdri",)),
    )
    scene = build(settings, base=base)
    assert any(len(o.parts) > 1 for o in things(scene))
    assert any(p.material.base_color != (1.0, 1.0, 1.0) for o in things(scene) for p in o.parts)
    sky = scene.objects[0]
    assert all(p.material.texture.image.dtype == np.float32 and p.material.uv_scale == (1, 1) for p in sky.parts)
    assert max(p.mesh.uvs.max() for p in sky.parts) < 1  # the margin keeps filtering away from the wrap
    assert fingerprint(build(settings, base=base)) == fingerprint(scene)


REFUSED = ConfigError, AssetError


@pytest.mark.parametrize(
    "tree, expected",
    [
        ({"objects": {"cuont": 3}}, "scene.objects.cuont: unknown key; expected 'count' (nearest)"),
        ({"objects": {"count": -1}}, "scene.objects.count: too small (got -1)"),
        ({"objects": {"size": [2, 1]}}, "scene.objects.size: the range must be [smallest, largest] (got [2, 1])"),
        ({"objects": {"size": [0, 1]}}, "scene.objects.size.0: too small (got 0)"),
        (
            {"pool": {"primitives": ["cube"]}},
            (
                "scene.pool.primitives: must be all or a list of cuboid, cylinder, sphere, icosphere, cone, torus, "
                "capsule, prism, pyramid, figure, flag, fish (got ['cube'])"
            ),
        ),
        ({"pool": {"urdfs": "maybe"}}, "scene.pool.urdfs: this key was removed (got 'maybe'); expected folders: [...]"),
        (
            {"pool": {"test_fraction": 1.5}},
            "scene.pool.test_fraction: too large (got 1.5); expected a number from 0 to 1",
        ),
        (
            {"textures": {"procedural": ["noise"]}},
            "scene.textures.procedural: must be true, false or a list of value, perlin,",
        ),
        ({"sky": {"size": 20}}, "scene.sky.size: must be at least 36 to hold the region and its objects (got 20.0)"),
        (
            {"region": {"height": 0.5}},
            "scene.region.height: the camera starts above it (got 0.5); expected more than 1 m",
        ),
    ],
)
def test_configuration_errors(tree, expected):
    assert refusal(REFUSED, validate, RandomSceneConfig, tree, where="scene").startswith(expected)


def test_assets_are_checked_before_work_starts(tmp_path):
    check_assets(config(), tmp_path)
    explicit = validate(
        ExplicitSceneConfig,
        {"kind": "explicit", "meshes": {"a": {"file": "gone.obj"}}, "objects": [{"mesh": "a"}], "camera": {}},
    )
    for settings, expected in (
        (config(pool=PoolConfig(folders=("gone",))), "scene.pool.folders.0: no such folder (got 'gone')"),
        (config(pool=PoolConfig(primitives=())), "scene.pool: the pool of meshes is empty"),
        (config(textures=TexturesConfig(folders=("gone",))), "scene.textures.folders.0: no such folder"),
        (explicit, "scene.meshes.a.file: no such file (got 'gone.obj'); expected a mesh file"),
    ):
        assert refusal(REFUSED, check_assets, settings, tmp_path).startswith(expected)
    lost = config(sky=SkyConfig(panoramas=("gone.hdr",)))
    assert refusal(REFUSED, build, lost, base=tmp_path).startswith("scene.sky.panoramas.0: no such file or folder")
    unknown = refusal(REFUSED, build, config(), split="val")
    assert unknown == "output.split: unknown split (got 'val'); expected train or test"


def test_a_camera_that_runs_into_something_gets_another_path(monkeypatch, tmp_path):
    """The first path is reported as cut; the world then draws another, and the scene's camera is not stopped."""
    from blinkgl.scene.motion.collision import Collision
    from blinkgl.scene.worlds import random_world as module

    drawn, resolve = [], module.resolve_collisions

    def once_unlucky(objects, path, *rest):
        drawn.append(path)
        result = resolve(objects, path, *rest)
        if len(drawn) == 1:
            return replace(result, events=(Collision(1, "camera", objects[0].name, 0.0, ("camera",)),))
        return result

    monkeypatch.setattr(module, "resolve_collisions", once_unlucky)
    scene = module.random_world(config(), CAMERA.model, 0, 10**9, "train", 3, 0, tmp_path)
    assert len(drawn) >= 2 and not np.allclose(drawn[0].pose(5 * 10**8), drawn[1].pose(5 * 10**8))
    assert scene.camera_path is drawn[-1]
