"""Worlds in which things fall: what of a random world does not change, where bodies may be, what is left out; explicit
scenes, their collisions, and the errors in their configuration."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.config.camera import CameraConfig, camera_radius
from blinkgl.config.physics import RandomPhysicsConfig
from blinkgl.config.problems import validate
from blinkgl.config.scene import ExplicitSceneConfig, ObjectsConfig, PoolConfig, RandomSceneConfig, TexturesConfig
from blinkgl.errors import ConfigError
from blinkgl.scene.build import build_scene
from blinkgl.scene.motion.paths import HermitePath
from tests.refusals import refusal

CAMERA = CameraConfig(width=96, height=72)
T1 = 1_000_000_000
PLAIN = RandomSceneConfig(
    textures=TexturesConfig(max_size=32, variants=4, photographs=False),
    pool=PoolConfig(primitives=("cuboid", "sphere", "cone"), variants=8),
    objects=ObjectsConfig(count=8, distance=(2.0, 8.0), size=(0.4, 1.2)),
)


def world(sequence=0, **physics):
    pytest.importorskip("mujoco")
    settings = PLAIN.model_copy(update={"physics": RandomPhysicsConfig(**physics)})
    return build_scene(settings, CAMERA, 0, T1, sequence=sequence)


def test_falling_things_stay_where_they_may_be():
    """Above the ground, clear of the camera and of each other but for what an impact sinks in; and some fall."""
    scene, t = world(share=1.0, thrown=0.6), np.arange(0, T1, 5_000_000)
    falling = [o for o in scene.objects if isinstance(o.path, HermitePath)]
    assert len(falling) == scene.dynamics.bodies >= 6
    clearance = camera_radius(CAMERA.model, PLAIN.camera_clearance)
    eye = scene.camera_path.poses(t)[:, :3, 3]
    moved = 0
    for o in falling:
        T = o.path.poses(t)
        vertices = np.concatenate([p.mesh.vertices for p in o.parts])
        world_v = np.einsum("nij,vj->nvi", T[:, :3, :3], vertices) + T[:, None, :3, 3]
        # A hundredth: a ball of facets is a ball to the engine, and rounder.
        assert world_v[..., 2].min() > -0.01 * o.radius - 0.006, o.name
        assert np.abs(world_v[..., :2]).max() < PLAIN.region.width / 2 + PLAIN.objects.size[1] + 0.1
        assert np.linalg.norm(world_v - eye[:, None], axis=2).min() > clearance - 0.02
        moved += np.ptp(T[:, 2, 3]) > 0.2
    assert moved >= 3


def test_physics_changes_only_what_falls():
    """Objects, places, textures and light are those of the world without; bodies are of a stream of their own."""
    plain, falling = build_scene(PLAIN, CAMERA, 0, T1), world(share=0.5, rate=4000)
    assert plain.dynamics is None
    assert [o.name for o in plain.objects] == [o.name for o in falling.objects]
    for a, b in zip(plain.objects, falling.objects):
        assert a.category != "object" or np.abs(a.path.pose(0) - b.path.pose(0)).max() < 0.02 * a.radius
        assert all(p.mesh.source_hash == q.mesh.source_hash for p, q in zip(a.parts, b.parts))
    assert plain.light == falling.light
    assert world(share=0.5, rate=4000).dynamics == falling.dynamics
    assert world(share=0.5, rate=4000, sequence=1).dynamics.digest != falling.dynamics.digest
    assert world(share=0.0).dynamics is None


def test_what_comes_to_be_too_fast_is_left_out_and_the_log_says_so():
    scene = world(share=1.0, thrown=0.0, max_speed=2.0, rate=4000)
    gone = [line for line in scene.log if "faster than scene.physics.max_speed" in line]
    assert gone and len(scene.objects) < len(world(share=1.0, thrown=0.0, rate=4000).objects)
    assert all(line.split(": ")[1] not in {o.name for o in scene.objects} for line in gone)


EXPLICIT = {
    "kind": "explicit",
    "physics": {},
    "meshes": {"box": {"primitive": "cuboid"}, "floor": {"primitive": "grid", "parameters": {"width": 9, "depth": 9}}},
    "objects": [
        {"mesh": "floor", "category": "ground"},
        {"mesh": "box", "position": [3, 0, 2], "scale": 0.4, "physics": {"restitution": 0.0}},
    ],
    "camera": {"position": [0, 0, 1]},
}


def explicit(**changes):
    return validate(ExplicitSceneConfig, {**EXPLICIT, **changes})


def test_collisions_leave_what_falls_to_the_engine():
    """A key-framed box is stopped at a wall by blinkgl's own check; the falling one lands on it as it then stands."""
    pytest.importorskip("mujoco")
    sled = {
        "mesh": "box",
        "name": "sled",
        "keyframes": [{"time": t, "position": [2 + 4 * t, 0, 0.51]} for t in (0, 1)],
        "interpolation": "linear",
    }
    wall = {"mesh": "box", "name": "wall", "position": [4.0, 0, 0.5], "category": "wall"}
    settings = explicit(collisions=True, objects=[*EXPLICIT["objects"], sled, wall])
    scene = build_scene(settings, CAMERA, 0, T1)
    assert any("sled" in line and "stopped" in line for line in scene.log)
    assert not any("t=0.0" in line and "box" in line for line in scene.log)
    end = {o.name: o.path.pose(T1)[:3, 3] for o in scene.objects}
    assert end["sled"][0] == pytest.approx(3.0, abs=0.01)
    assert end["box"][2] == pytest.approx(1.01 + 0.2, abs=0.02), "it lies on the sled"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"physics": None}, "objects.1.physics: the scene has no physics; expected scene.physics, too"),
        ({"objects": EXPLICIT["objects"][:1]}, "physics: no object has dynamic physics"),
        (
            {"objects": [{**EXPLICIT["objects"][1], "physics": {"kind": "fixed", "spin": [0, 0, 9]}}]},
            (
                r"objects.0.physics.spin: a fixed body does not use this key \(got \[0.0, 0.0, 9.0\]\); "
                r"expected kind: dynamic"
            ),
        ),
        (
            {
                "objects": [
                    {"mesh": "box", "physics": {}, "keyframes": [{"time": 0}, {"time": 1, "position": [1, 0, 0]}]}
                ]
            },
            "objects.0.physics.kind: a dynamic body has no key frames",
        ),
    ],
)
def test_configurations_that_make_no_sense(changes, message):
    refusal(ConfigError, explicit, match=message, **changes)
