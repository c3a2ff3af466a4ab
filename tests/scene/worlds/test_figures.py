"""Files whose shapes change: skins, morph targets and clips, alone, in explicit scenes, in scene files and in pools."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from shared_data import shared

from blinkgl.config.camera import CameraConfig
from blinkgl.config.deform import AnimationConfig
from blinkgl.config.problems import validate
from blinkgl.config.scene import ExplicitSceneConfig, FileSceneConfig, RandomSceneConfig
from blinkgl.errors import AssetError, ConfigError
from blinkgl.scene.build import build_scene
from blinkgl.scene.geometry import BUILDERS
from blinkgl.scene.importing import gltf
from blinkgl.scene.importing.mesh_files import clip_of, load_asset
from blinkgl.scene.importing.parts import Z_UP
from blinkgl.scene.shapes.sweep import sweep
from tests.refusals import refusal
from tests.scene.faces import vectors
from tests.scene.gltf_files import arm_file

SECOND = 10**9
CAMERA = CameraConfig(width=48, height=36)


def arm(folder, name="arm.glb", **options):
    """The path of :func:`arm_file`, written there."""
    return arm_file(**options).write(folder / name)


def bent(vertices, weights, angle, swell=0.0):
    """What the file's formula makes of it, y up: the part above y = 0 turns about z through the origin."""
    swollen = vertices * [1 + swell * 0.5, 1, 1]
    turned = swollen @ Rotation.from_rotvec([0, 0, angle]).as_matrix().T
    return (1 - weights)[:, None] * swollen + weights[:, None] * turned


@pytest.mark.parametrize("kind, at_quarter", [("LINEAR", 0.35), ("CUBICSPLINE", None), ("STEP", 0.0)])
@pytest.mark.parametrize("normalised", [False, True])
def test_a_skin_is_where_its_joints_take_it(tmp_path, kind, at_quarter, normalised):
    path = arm(tmp_path, kind=kind, normalised=normalised, morphs=True)
    asset = load_asset(path, play=clip_of(AnimationConfig(clip="wave")))
    assert asset.clips == ("wave",) and asset.omissions == ()
    mesh = asset.parts[0].mesh
    # At rest the mesh lies where its own node is; the skin brings it back.
    rest = mesh.vertices @ Z_UP[:3, :3] - 9
    up = np.clip(rest[:, 1] / 0.8 + 0.5, 0, 1)
    for t, angle, swell in ((0.0, 0.0, 0.0), (0.5, 0.7, 1.0), (1.5, 0.7, 1.0), (0.25, at_quarter, 0.5)):
        if angle is not None:
            true = bent(rest, up, angle, swell) @ Z_UP[:3, :3].T
            np.testing.assert_allclose(
                mesh.deformer.positions(mesh, round(t * 1e9)), true, atol=3e-3 if normalised else 1e-6
            )


def test_a_clip_of_another_file_and_a_faster_one(tmp_path):
    path, still = arm(tmp_path), arm(tmp_path, "still.glb", change=lambda b: b.tree.pop("animations"))
    other = load_asset(still, play=clip_of(AnimationConfig(file="arm.glb"), tmp_path))
    own = load_asset(path, play=clip_of(AnimationConfig()))
    a, b = (asset.parts[0].mesh for asset in (other, own))
    np.testing.assert_array_equal(a.deformer.positions(a, SECOND // 3), b.deformer.positions(b, SECOND // 3))
    fast = load_asset(path, play=clip_of(AnimationConfig(speed=2, loop=False))).parts[0].mesh
    np.testing.assert_allclose(
        fast.deformer.positions(fast, SECOND // 4), b.deformer.positions(b, SECOND // 2), atol=1e-12
    )
    np.testing.assert_allclose(fast.deformer.positions(fast, 9 * SECOND), b.deformer.positions(b, 0), atol=1e-12)


def posed(builder):
    """At rest the upper joint is turned, and the target has a weight."""
    nodes = {node["name"]: node for node in builder.tree["nodes"]}
    nodes["upper"]["rotation"] = [float(v) for v in Rotation.from_rotvec([0, 0, 0.4]).as_quat()]
    builder.tree["meshes"][0]["weights"] = [0.6]


def assert_is_the_bar(vertices, angle, swell):
    """All vertices of the bar of :func:`arm_file` so bent, z up, and no others, in whatever order."""
    rest = BUILDERS["cuboid"](extents=(0.4, 2.0, 0.4), subdivisions=4)
    up = np.clip(rest.vertices[:, 1] / 0.8 + 0.5, 0, 1)
    true = bent(rest.vertices, up, angle, swell) @ Z_UP[:3, :3].T
    assert max(cKDTree(true).query(vertices)[0].max(), cKDTree(vertices).query(true)[0].max()) < 1e-6


@pytest.mark.parametrize("change, angle, swell", [(None, 0.0, 0.0), (posed, 0.4, 0.6)])
def test_a_file_of_which_nothing_is_played_is_drawn_at_rest(tmp_path, change, angle, swell):
    """Joints where its nodes are, targets with the file's weights: as any viewer shows it. As an object, as a scene,
    and by the pool."""
    path = arm(tmp_path, morphs=True, change=change)
    asset = load_asset(path)
    assert asset.parts[0].mesh.deformer is None
    assert asset.omissions == ("arm.glb asks for what is not drawn: animations (the rest pose is drawn)",)
    camera = {"position": [0, -6, 0], "look_at": [0, 0, 0]}
    scene = scene_of(tmp_path, FileSceneConfig, kind="file", path="arm.glb", animation=None, pose=camera)
    (bar,) = scene.objects
    assert not bar.deforms and bar.is_static
    for mesh, T in ((asset.parts[0].mesh, np.eye(4)), (bar.parts[0].mesh, bar.path.pose(0))):
        assert_is_the_bar(mesh.vertices @ T[:3, :3].T + T[:3, 3], angle, swell)
        flat = vectors(mesh.vertices, mesh.faces)
        assert ((mesh.normals[mesh.faces] * flat[:, None]).sum(axis=2) > 0).all()  # they turned with it
    bare = load_asset(path, keep_materials=False).parts[0].mesh
    np.testing.assert_array_equal(bare.vertices, asset.parts[0].mesh.vertices)


def test_a_skin_that_is_wrong_is_refused_at_rest_too(tmp_path):
    path = arm(tmp_path, change=lambda b: bind(b, np.full((2, 16), np.nan)))
    refusal(AssetError, load_asset, path, match="arm.glb: the inverse bind matrix of joint 0 of a skin is not finite")


def scene_of(tmp_path, model, **tree):
    return build_scene(validate(model, tree, where="scene"), CAMERA, 0, SECOND, base=tmp_path)


def explicit(tmp_path, **keys):
    return scene_of(
        tmp_path,
        ExplicitSceneConfig,
        kind="explicit",
        meshes={"arm": {"file": "arm.glb"}, "box": {"primitive": "cuboid"}},
        objects=[{"mesh": "arm", **keys}],
        camera={"position": [-5, 0, 0]},
    )


def test_an_object_plays_a_clip_at_its_size(tmp_path):
    arm(tmp_path)
    small, large = (explicit(tmp_path, animation="wave", scale=s).objects[0] for s in (1, 3))
    assert small.deforms and not small.is_static and small.path.is_static
    a, b = (o.parts[0].mesh for o in (small, large))
    np.testing.assert_allclose(b.deformer.positions(b, 400), 3 * a.deformer.positions(a, 400), atol=1e-12)
    assert not explicit(tmp_path).objects[0].deforms


@pytest.mark.parametrize(
    "keys, said",
    [
        ({"animation": "dance"}, r"scene.objects.0.animation: no such animation in the file .got 'dance'.; .*: wave"),
        ({"animation": {"file": "none.glb"}}, r"scene.objects.0.animation.file: no such file"),
        ({"animation": {"blend": {"clip": 7}}}, r"animation.blend: this key was removed .*; expected one clip"),
        ({"animation": 0, "deform": {}}, "deform and animation exclude each other"),
        ({"mesh": "box", "animation": 0}, "only glTF files have animations"),
        ({"animation": {"speed": "fast"}}, "animation"),
    ],
)  # fmt: skip
def test_what_an_object_cannot_play(tmp_path, keys, said):
    arm(tmp_path)
    refusal(ConfigError, explicit, tmp_path, match=said, **keys)


def test_a_scene_file_plays_its_skins(tmp_path):
    arm(tmp_path, morphs=True)
    camera = {"position": [0, -6, 0], "look_at": [0, 0, 0]}
    scene = scene_of(tmp_path, FileSceneConfig, kind="file", path="arm.glb", pose=camera)
    (bar,) = scene.objects
    assert bar.deforms and bar.path.is_static and scene.omissions == ()
    mesh = bar.parts[0].mesh
    rest = mesh.vertices @ Z_UP[:3, :3] - 9  # where its node is, which the skin takes back
    up = np.clip(rest[:, 1] / 0.8 + 0.5, 0, 1)
    true = bent(rest, up, 0.7, 1.0) @ Z_UP[:3, :3].T
    np.testing.assert_allclose(mesh.deformer.positions(mesh, SECOND // 2), true, atol=1e-6)


def test_figures_enter_random_worlds_playing(tmp_path):
    folder = tmp_path / "figures"
    folder.mkdir()
    arm(folder)
    world = {
        "pool": {"primitives": [], "folders": ["figures"], "test_fraction": 0},
        "textures": {"procedural": ["checks"], "photographs": False, "max_size": 32, "test_fraction": 0},
        "objects": {"count": 4, "distance": [2, 8]},
    }
    scene = scene_of(tmp_path, RandomSceneConfig, kind="random", **world)
    arms = [o for o in scene.objects if o.category == "object"]
    assert len(arms) >= 2 and all(o.deforms for o in arms)
    assert any("plays 'wave'" in line for line in scene.log)
    assert len({o.parts[0].mesh.deformer.period_ns for o in arms}) == len(arms)  # each at a speed of its own
    for body in arms:  # and all of what it sweeps is in the sphere that was kept free
        points, margin = sweep(body.parts[0].mesh, 0, SECOND).hull, 1e-3
        assert np.linalg.norm(points[0], axis=1).max() <= 2.2 / 2 + margin
    again = scene_of(tmp_path, RandomSceneConfig, kind="random", **world)
    assert [o.parts[0].mesh.deformer.period_ns for o in again.objects if o.deforms] == [
        o.parts[0].mesh.deformer.period_ns for o in scene.objects if o.deforms
    ]
    rest = scene_of(
        tmp_path, RandomSceneConfig, kind="random", **world | {"pool": world["pool"] | {"animation": "rest"}}
    )
    assert not any(o.deforms for o in rest.objects)


def test_a_share_of_a_random_world_deforms():
    world = {
        "pool": {"primitives": ["cuboid", "sphere"], "variants": 4, "test_fraction": 0},
        "textures": {"procedural": ["checks"], "photographs": False, "max_size": 32, "test_fraction": 0},
    }

    def of(**objects):
        return scene_of(".", RandomSceneConfig, kind="random", **world, objects={"count": 8, **objects})

    plain, half, flags = of(), of(deform={"share": 0.5}), of(deform={"share": 1, "kinds": ["flag"]})
    assert not any(o.deforms for o in plain.objects)
    ours = [o for o in half.objects if o.category == "object"]
    assert 0 < sum(o.deforms for o in ours) < len(ours)
    kinds = {type(o.parts[0].mesh.deformer).__name__ for o in ours if o.deforms}
    assert len(kinds) > 1
    assert {type(o.parts[0].mesh.deformer).__name__ for o in flags.objects if o.deforms} == {"Flag"}
    rigid = {o.name: o for o in plain.objects}
    for o in ours:
        if o.deforms:
            mesh = o.parts[0].mesh
            assert np.linalg.norm(sweep(mesh, 0, SECOND).hull[0], axis=1).max() <= rigid[o.name].radius * 1.001
        elif o.name in rigid:
            np.testing.assert_array_equal(o.parts[0].mesh.vertices, rigid[o.name].parts[0].mesh.vertices)
    refusal(ConfigError, of, deform={"kinds": ["melt"]}, match="no such kind of deformation .got 'melt'")


# ---- files that are wrong --------------------------------------------------------------------------------------------


def attributes(builder):
    return builder.tree["meshes"][0]["primitives"][0]["attributes"]


def times(builder, *values):
    builder.tree["animations"][0]["samplers"][0]["input"] = builder.array(np.array(values, "f4"), "SCALAR")


def joints(builder, *numbers):
    builder.node(root=False, name="elsewhere")
    builder.tree["skins"][0]["joints"] = list(numbers)


def many_joints(builder, count):
    joints(builder, *[0] * count)
    bind(builder, np.tile(np.eye(4, dtype="f4").ravel(), (count, 1)))


def bind(builder, matrices):
    builder.tree["skins"][0]["inverseBindMatrices"] = builder.array(np.asarray(matrices, "f4"), "MAT4")


def every_vertex(builder, name, value, dtype):
    count = builder.tree["accessors"][attributes(builder)["POSITION"]]["count"]
    attributes(builder)[name] = builder.array(np.full((count, 4), value, dtype), "VEC4")


def short_target(builder):
    builder.tree["meshes"][0]["primitives"][0]["targets"] = [
        {"POSITION": builder.array(np.zeros((1, 3), "f4"), "VEC3")}
    ]


@pytest.mark.parametrize(
    "problem, change",
    [
        ("has times that do not increase", lambda b: times(b, 0, 0.5, 0.2)),
        ("a joint that is not in the scene", lambda b: joints(b, 0, 3)),
        ("a reference to node that does not exist", lambda b: joints(b, 0, 99)),
        ("does not have one inverse bind matrix per joint", lambda b: joints(b, 0, 1, 1)),
        ("inverse bind matrix of joint 0 of a skin is not finite", lambda b: bind(b, np.full((2, 16), np.nan))),
        ("sum to zero", lambda b: every_vertex(b, "WEIGHTS_0", 0.0, "f4")),
        ("negative or no number", lambda b: every_vertex(b, "WEIGHTS_0", np.nan, "f4")),
        ("follows a joint that does not exist", lambda b: every_vertex(b, "JOINTS_0", 9, "u1")),
        ("a morph target has another size", short_target),
        ("the nodes are no tree", lambda b: b.tree["nodes"][0].update(children=[1])),
        ("too many joints and morph targets", lambda b: many_joints(b, 400)),
        ("a skin has too many joints", lambda b: many_joints(b, 1_000_000)),
        ("skins.0.joints", joints),
    ],
    ids=lambda value: value[:40] if isinstance(value, str) else "",
)
def test_a_broken_file_is_refused_in_one_line(tmp_path, problem, change):
    path, play = arm(tmp_path, change=change), clip_of(AnimationConfig())
    assert "arm.glb" in refusal(AssetError, load_asset, path, match=problem, play=play)


# ---- the mannequins --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["running", "cheering", "push_ups"])
def test_mannequins_are_where_the_formula_of_the_standard_puts_them(name):
    """Joint by joint with scipy's rotations, from the file's own JSON."""
    path = shared(f"data/assets/characters/mannequin_{name}.glb")
    asset, document = load_asset(path, play=clip_of(AnimationConfig())), gltf.read(path)
    tree = document.tree
    animation, skin = tree["animations"][0], tree["skins"][0]
    read = lambda accessor: document.accessor(accessor).astype(float)
    bind = read(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
    parents = {c: i for i, n in enumerate(tree["nodes"]) for c in n.get("children", [])}
    figures = [i for i in document.nodes if document.nodes[i].mesh is not None]
    keys = [read(sampler["input"]) for sampler in animation["samplers"]]
    first, last = min(k.min() for k in keys), max(k.max() for k in keys)
    bound = []
    for node in figures:
        attributes = tree["meshes"][tree["nodes"][node]["mesh"]]["primitives"][0]["attributes"]
        p, j, w = (read(attributes[name]) for name in ("POSITION", "JOINTS_0", "WEIGHTS_0"))
        (raw,) = document.raw_meshes(document.nodes[node].mesh)
        bound.append((np.c_[p, np.ones(len(p))], j.astype(int), w / w.sum(axis=1, keepdims=True), raw.faces))
    for t in np.linspace(first, last - 1e-3, 20):
        local = {}
        for channel in animation["channels"]:
            sampler, target = animation["samplers"][channel["sampler"]], channel["target"]
            times, values = read(sampler["input"]).ravel(), read(sampler["output"])
            local[target["node"], target["path"]] = between(times, values, t, target["path"])

        def world(i, local=local):
            node, T = tree["nodes"][i], np.eye(4)
            turn = local.get((i, "rotation"), node.get("rotation", (0, 0, 0, 1)))
            T[:3, :3] = Rotation.from_quat(turn).as_matrix() * local.get((i, "scale"), node.get("scale", (1, 1, 1)))
            T[:3, 3] = local.get((i, "translation"), node.get("translation", (0, 0, 0)))
            return world(parents[i]) @ T if i in parents else T

        joints = np.stack([world(j) for j in skin["joints"]]) @ bind
        for part, (p, j, w, faces) in zip(asset.parts, bound):
            true = np.einsum("vkij,vk,vj->vi", joints[j], w, p, optimize=True)[:, :3] @ Z_UP[:3, :3].T
            mine = part.mesh.deformer.positions(part.mesh, round(t * 1e9))
            assert np.abs(mine[part.mesh.faces] - true[faces]).max() < 1e-5 * np.ptp(true, axis=0).max()


def between(times, values, t, path):
    i = int(np.clip(np.searchsorted(times, t, side="right") - 1, 0, max(len(times) - 2, 0)))
    if len(times) == 1 or t >= times[-1]:
        return values[-1]
    s = (t - times[i]) / (times[i + 1] - times[i])
    if path == "rotation":
        a, b = Rotation.from_quat(values[i]), Rotation.from_quat(values[i + 1])
        return (a * Rotation.from_rotvec(s * (a.inv() * b).as_rotvec())).as_quat()
    return (1 - s) * values[i] + s * values[i + 1]
