"""The front door: names, documentation, one path each; scenes in Python are scenes of YAML;
wrong calls say which argument."""

from __future__ import annotations

import ast
import inspect
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from scipy.spatial.transform import Rotation

import blinkgl
from blinkgl.config.run import RunTemplate
from blinkgl.errors import BlinkGLError, ConfigError
from blinkgl.front.sections import labels_tree
from blinkgl.io.dsec import DsecEventReader
from blinkgl.scene.build import build_scene
from tests.scene.gltf_files import GltfBuilder, arm_file

REPOSITORY = Path(__file__).resolve().parents[1]


def box_scene(**more) -> blinkgl.Scene:
    """A box passes the camera: 32 x 24 px, two labels at 20 Hz."""
    path = blinkgl.Keyframes(
        {0: blinkgl.look_at((-2, -0.3, 0.8), (0, 0, 0)), 0.2: blinkgl.look_at((-2, 0.3, 0.8), (0, 0, 0))}
    )
    settings = {"duration": 0.1, "label_rate": 20, "seed": 3, **more}
    return blinkgl.Scene(blinkgl.Camera(32, 24, pose=path), **settings) + blinkgl.Primitive(
        "cuboid", material=blinkgl.Material(procedural="bricks", seed=2)
    )


# --- names ------------------------------------------------------------------------------------------------------------


def test_import_brings_nothing_with_it():
    code = (
        "import sys, blinkgl; blinkgl.__version__; dir(blinkgl); print([m for m in sys.modules if "
        "(m.startswith('blinkgl.') and m != 'blinkgl.version') or m in ('numpy', 'numba', 'moderngl', 'pydantic')])"
    )
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"
    )


def test_reading_events_waits_for_no_emulator():
    """Nor for SciPy and the configuration: a program that reads one file starts at once."""
    code = (
        "import sys; from blinkgl import read_events; print({'numba', 'scipy', 'pydantic', 'cv2'} & set(sys.modules))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "set()"


def test_the_names_of_the_package_are_those_that_it_gives():
    assert {name for name in dir(blinkgl) if not name.startswith("__")} == set(blinkgl.__all__) - {"__version__"}


def test_table_list_and_type_checker_agree():
    assert sorted(blinkgl._HOME) == sorted(blinkgl.__all__) and 30 <= len(blinkgl.__all__) <= 64
    tree = ast.parse((REPOSITORY / "blinkgl/__init__.py").read_text(encoding="utf-8"))
    typed = [
        node
        for branch in tree.body
        if isinstance(branch, ast.If)
        for node in branch.body
        if isinstance(node, ast.ImportFrom)
    ]
    assert {name.name: node.module for node in typed for name in node.names} == blinkgl._HOME
    assert set(blinkgl.__all__) <= set(dir(blinkgl))
    with pytest.raises(AttributeError, match="no_such_name"):
        blinkgl.no_such_name  # noqa: B018


@pytest.mark.parametrize("name", sorted(blinkgl._HOME))
def test_every_name_exists_and_says_what_it_is(name):
    if name.startswith("Tensor"):
        pytest.importorskip("torch")
    text = inspect.getdoc(getattr(blinkgl, name))
    assert text and len(text) > 20


# --- scenes -----------------------------------------------------------------------------------------------------------


def test_a_scene_in_python_is_the_scene_of_its_yaml():
    scene = box_scene(background=0.4) + blinkgl.Primitive(
        "sphere", radius=0.2, pose=blinkgl.Pose((0, 1, 0), euler=(0, 0, 30)), scale=2.0
    )
    template = scene.template()
    template = RunTemplate(yaml.safe_load(yaml.safe_dump(template.tree)), template.base)
    config = template.sequence(0)
    ours = scene.build(config)
    theirs = build_scene(config.scene, config.camera, config.time.t0_ns, config.time.t1_ns)
    assert [o.name for o in ours.objects] == [o.name for o in theirs.objects] == ["cuboid", "sphere"]
    for a, b in zip(ours.objects, theirs.objects):
        assert np.array_equal(a.parts[0].mesh.vertices, b.parts[0].mesh.vertices) and np.array_equal(
            a.path.pose(0), b.path.pose(0)
        )
        assert a.parts[0].material.texture is b.parts[0].material.texture is None or np.array_equal(
            a.parts[0].material.texture.image, b.parts[0].material.texture.image
        )
    assert np.array_equal(ours.camera.K, theirs.camera.K) and ours.light == theirs.light and ours.background == 0.4


def test_what_limits_a_recording_is_a_warning_where_it_was_asked_for():
    way = {0.0: blinkgl.Pose((2, -3, 0)), 0.1: blinkgl.Pose((2, 3, 0))}
    flies = blinkgl.Primitive("sphere", radius=0.2, pose=blinkgl.Keyframes(way))
    scene = blinkgl.Scene(blinkgl.Camera(64, 48, fov=60), [flies], duration=0.1)
    with pytest.warns(
        UserWarning, match="steps between event frames are 9000 µs long .* timeline.min_step_us"
    ) as given:
        blinkgl.record(scene, labels=[], timeline=blinkgl.Timeline("displacement", max_px=1, min_step_us=9000))
    assert given[0].filename == __file__


def test_record_is_what_generate_writes(tmp_path):
    scene = box_scene()
    labels = ("images", "forward", "backward", "occlusion", "depth")
    recording = blinkgl.record(scene, emulator={"emulator": "v2e", "cutoff_hz": 100}, sensor="davis346", labels=labels)
    outcome = blinkgl.generate(
        scene, tmp_path / "out", emulator={"emulator": "v2e", "cutoff_hz": 100}, sensor="davis346", labels=labels
    )
    assert outcome.made.events == len(recording.events) > 100
    folder = tmp_path / "out/train/sequence_000000"
    with DsecEventReader(folder / "events.h5") as file:
        written = file.slice(0, 10**6)
    for column in "xytp":
        assert np.array_equal(getattr(written, column), getattr(recording.events, column))
    for k in range(2):
        flow, valid = blinkgl.read_flow(folder / f"flow/forward/{k:06d}.png")
        assert np.array_equal(valid, recording.valid[k]) and np.abs(flow - recording.flow[k]).max() <= 1 / 256
        assert np.array_equal(np.load(folder / f"depth/{k:06d}.npy"), recording.labels[k].depth)
        import cv2

        assert np.array_equal(cv2.imread(str(folder / f"images/{k:06d}.png"))[..., ::-1], recording.images[k])
    assert recording.t_us.tolist() == [50_000, 100_000] and recording.image_t_us.tolist() == [50_000, 100_000, 150_000]
    assert len(recording.window(0)) == np.count_nonzero((written.t >= 50_000) & (written.t < 100_000))
    assert blinkgl.verify(tmp_path / "out").clean


def test_poses_from_matrices(tmp_path):
    """Whoever has (4, 4) poses gives them as they are: the camera's path passes them."""
    rng = np.random.default_rng(1)
    turns = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.15, (5, 3)), axis=0)) * Rotation.from_euler("x", -90, True)
    T = np.tile(np.eye(4), (5, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = turns.as_matrix(), rng.normal(0, 1, (5, 3))
    times = np.linspace(0, 1.2, 5)
    camera = blinkgl.Camera(32, 24, pose=blinkgl.Keyframes.from_arrays(times, T))
    scene = blinkgl.Scene(camera, duration=1.0) + blinkgl.Primitive("cuboid")
    path = scene.build(scene.template().sequence(0)).camera_path
    np.testing.assert_allclose(path.poses(np.round(times * 1e9).astype(np.int64)), T, atol=1e-7)
    body = blinkgl.Pose.from_matrix(T[2])
    np.testing.assert_allclose(body.tree["position"], T[2, :3, 3])
    for wrong, said in (
        (np.diag([1.0, 1, -1, 1]), "Pose.from_matrix: the matrix contains a reflection"),
        (2 * np.eye(4), "the last row of a pose is not 0, 0, 0, 1"),
        (np.eye(3), r"Pose.from_matrix: array of another type or shape .*expected an array \(4, 4\)"),
    ):
        with pytest.raises(blinkgl.ConfigError, match=said):
            blinkgl.Pose.from_matrix(wrong)
    with pytest.raises(blinkgl.ConfigError, match=r"from_arrays.times_s: times do not increase"):
        blinkgl.Keyframes.from_arrays([0, 1, 1, 2, 3], T)
    with pytest.raises(blinkgl.ConfigError, match=r"from_arrays.T\[3\]: the matrix contains a reflection"):
        blinkgl.Keyframes.from_arrays(times, np.where(np.arange(5)[:, None, None] == 3, np.diag([1.0, 1, -1, 1]), T))


def test_arrays_as_mesh_and_image():
    image = np.zeros((8, 8, 3), np.uint8)
    image[:, 4:] = 255
    square = dict(
        vertices=[[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]],
        faces=[[0, 2, 1], [0, 3, 2]],
        uvs=[[0, 1], [1, 1], [1, 0], [0, 0]],
    )
    camera = blinkgl.Camera(32, 32, fov=53.13, pose=(-2, 0, 0))
    scene = blinkgl.Scene(camera, light=blinkgl.Light(unlit=True), background=0.5) + blinkgl.Mesh(
        **square, material=blinkgl.Material(image, both_sides=True)
    )
    frame = blinkgl.render_frame(scene, 0.0, ["images", "depth", "ids"])
    # The camera looks along +x, so that +y, where u is 1, is on its left.
    assert np.allclose(frame.depth[8:24, 8:24], 2, atol=1e-4) and (frame.ids[8:24, 8:24] == 1).all()
    assert frame.colour[16, 6].max() > 0.9 and frame.colour[16, 26].max() < 0.1
    assert not scene.on_disk
    with pytest.raises(blinkgl.ConfigError, match="^source: the scene contains arrays"):
        blinkgl.generate(scene, "nowhere")


def test_light_is_that_of_yaml_and_what_duration_leaves_out_is_said():
    given = RunTemplate({"scene": {"kind": "random"}}, Path()).sequence(0).scene.light
    assert box_scene().template().sequence(0).scene.light == given and (given.sun, given.sky) == (0.6, 0.4)
    cut = box_scene(duration=0.07)
    said = (
        "time.duration: 0.07 s are 0.05 s, 1 intervals of labels (a multiple of 1 / time.label_rate = 0.05 s is whole)"
    )
    made, whole = (one.build(one.template().sequence(0)) for one in (cut, box_scene()))
    assert made.omissions == (said,) and whole.omissions == ()


def test_emulators_take_a_sensor():
    assert blinkgl.V2e(4, 4, sensor="davis346").config == blinkgl.load_sensor("davis346").emulator("v2e")
    assert blinkgl.Esim(4, 4, sensor="davis346", contrast_threshold=0.5).config.contrast_threshold == 0.5
    assert blinkgl.DvsVoltmeter(4, 4, preset="DVS240").config.k1 == pytest.approx(4.424)


# --- wrong calls ------------------------------------------------------------------------------------------------------

b, C, P, S, K, M = blinkgl, blinkgl.Camera, blinkgl.Primitive, blinkgl.Scene, blinkgl.Keyframes, blinkgl.Material
triangle = dict(vertices=[[0, 0, 0], [1, 0, 0], [0, 1, 0]], faces=[[0, 1, 2]])
events = blinkgl.Events(np.zeros(1, np.uint16), np.zeros(1, np.uint16), np.zeros(1, np.int64), np.zeros(1, np.uint8))
grey = np.zeros((4, 4), np.uint8)
WRONG = [
    ("Camera.width", lambda d: C("wide")),
    ("Camera.width", lambda d: C(0)),
    ("Camera.fov", lambda d: C(32, 24, fov=200)),
    ("Camera", lambda d: C(32, 24, fov=60, focal=100)),
    ("Camera.pose", lambda d: C(pose=3)),
    ("Pose.position", lambda d: b.Pose((1, 2))),
    ("Pose.position.1", lambda d: C(pose=(1, float("nan"), 2))),
    ("Pose", lambda d: b.Pose(euler=(0, 0, 1), look_at=(1, 0, 0))),
    ("Pose.look_at", lambda d: b.look_at((1, 1, 1), (1, 1, 1))),
    ("Pose.quaternion", lambda d: b.Pose(quaternion="x")),
    ("Keyframes.poses", lambda d: K({})),
    ("Keyframes.poses", lambda d: K({0: b.Pose()})),
    ("Keyframes.poses[1]", lambda d: K({0: b.Pose(), 1: (0, 0, 1)})),
    ("Keyframes.poses", lambda d: K({"now": b.Pose(), "then": b.Pose()})),
    ("Keyframes.interpolation", lambda d: K({0: b.Pose(), 1: b.Pose((1, 0, 0))}, "cubic")),
    ("Primitive.kind", lambda d: P("teapot")),
    ("Primitive.kind", lambda d: P(None)),
    ("Primitive.colour", lambda d: P("cuboid", colour="red")),
    ("Primitive.radius", lambda d: P("sphere", radius=-1)),
    ("Primitive.material", lambda d: P("cuboid", material="red")),
    ("Primitive.scale", lambda d: P("cuboid", scale=0)),
    ("Primitive.category", lambda d: P("cuboid", category="thing")),
    ("Mesh.file", lambda d: b.Mesh()),
    ("Mesh.faces", lambda d: b.Mesh(vertices=triangle["vertices"], faces=[[0, 1, 7]])),
    ("Mesh.vertices", lambda d: b.Mesh(vertices=[[0, 1], [2]], faces=[[0, 1, 2]])),
    ("Mesh.uvs", lambda d: b.Mesh(**triangle, uvs=[[0, 0]])),
    ("Mesh.file", lambda d: b.record(S() + b.Mesh(d / "none.obj"))),
    ("Material.image", lambda d: M(np.zeros((4, 4)))),
    ("Material.image", lambda d: M(np.full((4, 4, 3), -1.0))),
    ("Material.color", lambda d: M(color="red")),
    ("Material", lambda d: M("a.png", procedural="bricks")),
    ("Light.elevation", lambda d: b.Light(elevation=100)),
    ("Light.shadows", lambda d: b.Light(shadows="long")),
    ("Light.shadow_size", lambda d: b.Light(shadow_size=3)),
    ("Light.environment", lambda d: b.Light(environment="park.hdr")),
    ("Light.environment.map", lambda d: b.Light(environment={"heading": 3})),
    ("Light.environment.map", lambda d: b.record(box_scene(light=b.Light(environment={"map": "none.hdr"})))),
    ("Scene.camera", lambda d: S("camera")),
    ("Scene.objects[0]", lambda d: S(objects=["box"])),
    ("Scene.duration", lambda d: S(duration=-1)),
    ("Scene.label_rate", lambda d: S(label_rate="often")),
    ("Scene.seed", lambda d: S(seed=-1)),
    ("labels", lambda d: b.record(box_scene(), labels=[["forward"]])),
    ("Scene.background", lambda d: S(background="x") + P("cuboid")),
    ("Scene + …", lambda d: S() + 3),
    ("Scene.objects", lambda d: b.record(S())),
    ("Timeline.max_px", lambda d: b.Timeline("displacement", max_px=-1)),
    ("Timeline.kind", lambda d: b.Timeline("sometimes")),
    ("source", lambda d: b.record("demo.yaml")),
    ("labels", lambda d: b.record(box_scene(), labels=["depht"])),
    ("labels", lambda d: b.render_frame(box_scene(), 0, "depth")),
    ("t", lambda d: b.render_frame(box_scene(), "soon")),
    ("index", lambda d: b.record(box_scene(), index=-1)),
    ("emulator", lambda d: b.record(box_scene(), emulator="dvs")),
    ("emulator", lambda d: b.record(box_scene(), emulator=3)),
    (
        "esim.contrast_threshold",
        lambda d: b.record(box_scene(), emulator={"emulator": "esim", "contrast_threshold": "low"}),
    ),
    ("sensor", lambda d: b.record(box_scene(), sensor="eye")),
    ("quality", lambda d: b.record(box_scene(), quality="best")),
    ("timeline", lambda d: b.record(box_scene(), timeline="uniform")),
    ("source", lambda d: b.simulate_sequence(d / "a.yaml")),
    ("index", lambda d: b.simulate_sequence(box_scene(), index=1.5)),
    ("labels", lambda d: b.simulate_sequence(box_scene(), labels=["depht"])),
    ("emulator", lambda d: b.simulate_sequence(box_scene(), emulator="dvs")),
    ("events", lambda d: b.simulate_sequence(box_scene(), events=0)),
    ("pictures_hz", lambda d: b.simulate_sequence(box_scene(), pictures_hz=0)),
    ("pictures_hz", lambda d: b.simulate_sequence(box_scene(), events=False, pictures_hz=30)),
    ("simulate_sequence", lambda d: [list(once) for once in [b.simulate_sequence(box_scene(), events=False)] * 2]),
    ("num", lambda d: b.generate(box_scene(), d / "out", num=0)),
    ("workers", lambda d: b.generate(box_scene(), d / "out", workers="two")),
    ("out", lambda d: b.generate(box_scene(), None)),
    ("height", lambda d: b.Esim(0, 10)),
    ("width", lambda d: b.V2e(10, 10.5)),
    ("esim.contrast_treshold", lambda d: b.Esim(4, 4, contrast_treshold=0.2)),
    ("seed", lambda d: b.DvsVoltmeter(4, 4, seed=-1)),
    ("frame 0", lambda d: b.Esim(4, 4).step([["a"] * 4] * 4, 0)),
    ("frame 0", lambda d: b.Esim(4, 4).step(np.zeros((4, 5), np.float32), 0)),
    ("frame 0", lambda d: b.Esim(4, 4).step(np.zeros((4, 4), np.float32), "now")),
    ("sensor", lambda d: b.load_sensor(3)),
    ("Events.x", lambda d: b.Events([1], events.y, events.t, events.p)),
    ("frames", lambda d: b.simulate(5)),
    ("fps", lambda d: b.simulate([grey], fps="fast")),
    ("frames[1]", lambda d: list(b.simulate([grey, ["a", [1]]], fps=10))),
    ("frames[0]", lambda d: list(b.simulate([(grey, "noon"), (grey, "one")]))),
    ("fpz", lambda d: b.simulate([grey], fpz=3)),
    ("gamma", lambda d: b.simulate([grey], fps=10, gamma=[])),
    ("interpolate", lambda d: b.simulate([grey], fps=10, interpolate=["linear"])),
    ("source", lambda d: b.simulate_file(None, d / "a.h5")),
    ("{d}/none.mp4", lambda d: b.simulate_file(d / "none.mp4", d / "a.h5")),
    ("path", lambda d: b.read_events(3)),
    ("{d}/none.h5", lambda d: b.read_events(d / "none.h5")),
    ("events", lambda d: b.write_events(d / "a.npz", [1, 2], 4, 4)),
    ("events", lambda d: b.write_events(d / "a.npz", None, 4, 4)),
    ("height", lambda d: b.write_events(d / "a.npz", events, "4", 4)),
    ("{d}/a.xyz", lambda d: b.write_events(d / "a.xyz", events, 4, 4)),
    ("size", lambda d: b.convert(d / "a.h5", d / "b.h5", size=3)),
    ("{d}/a.gif", lambda d: b.read_flow(d / "a.gif")),
    ("flow", lambda d: b.write_flow(d / "a.flo", np.zeros((4, 4)))),
    ("valid", lambda d: b.write_flow(d / "a.flo", np.zeros((4, 4, 2)), np.zeros((3, 3), bool))),
    ("interval_ms", lambda d: b.compare(d / "a.h5", interval_ms=0)),
    ("a", lambda d: b.compare(None)),
    ("recording", lambda d: b.calibrate(3)),
    ("frames", lambda d: b.calibrate(d / "a.h5", 3)),
    ("fixed", lambda d: b.calibrate(d / "a.h5", fixed="log_eps")),
    ("fixed", lambda d: b.calibrate(d / "a.h5", fixed=3)),
    ("emulator", lambda d: b.calibrate(d / "a.h5", emulator="jaer")),
    ("starts", lambda d: b.calibrate(d / "a.h5", starts=0)),
    ("gama", lambda d: b.calibrate(d / "a.h5", gama="srgb")),
    ("frame_delay_ms", lambda d: b.calibrate(d / "a.h5", frame_delay_ms="soon")),
    ("{d}/a.h5", lambda d: b.calibrate(d / "a.h5")),
    ("--still", lambda d: b.calibrate(d / "a.h5", d, still=True)),
    ("path", lambda d: b.load(None)),
    ("overrides", lambda d: b.load(d / "a.yaml", "camera.width=3")),
    ("seed", lambda d: b.load(d / "a.yaml", seed="x")),
    ("Body.restitution", lambda d: b.Body(restitution=2)),
    ("Primitive.body", lambda d: P("cuboid", body=3.0)),
    ("Deform.kind", lambda d: b.Deform("melt")),
    ("Deform.kind", lambda d: b.Deform(7)),
    ("Deform.amplitude", lambda d: b.Deform("wave", amplitude=-1)),
    ("Deform.angle", lambda d: b.Deform("wave", angle=3)),
    ("Deform.towards", lambda d: b.Deform("wave", along="z", towards="z")),
    ("Primitive.deform", lambda d: b.Primitive("cuboid", deform="wave")),
    ("Primitive.clip", lambda d: b.Primitive("figure", clip="jog")),
    ("Primitive.pose", lambda d: b.Primitive("figure", pose="ahead")),
    ("Animation.speed", lambda d: b.Animation(speed="fast")),
    ("Animation.clip", lambda d: b.Animation(1.5)),
    ("Mesh.animation", lambda d: b.Mesh("chair.obj", animation=0)),
    ("Mesh.animation", lambda d: b.Mesh("chair.glb", animation=1.5)),
    ("Mesh.deform", lambda d: b.Mesh("chair.glb", animation=0, deform=b.Deform())),
    ("Way.points", lambda d: b.Way([(0, 0, 0)])),
    ("Way.points.0", lambda d: b.Way([(0, 0), (1, 1)])),
    ("Way.speed", lambda d: b.Way([(0, 0, 0), (1, 0, 0)], speed=0)),
    ("Camera.pose", lambda d: b.Camera(pose=b.Way([(0, 0, 0), (1, 0, 0)]))),
    ("{d}/none", lambda d: b.verify(d / "none")),
    ("deep", lambda d: b.verify(d, deep=-1)),
]


@pytest.mark.parametrize("where, call", WRONG, ids=[f"{k}-{where}" for k, (where, _) in enumerate(WRONG)])
def test_wrong_calls_name_the_argument(where, call, tmp_path):
    with pytest.raises(BlinkGLError) as caught:
        call(tmp_path)
    line = str(caught.value)
    assert line.startswith(where.format(d=tmp_path) + ": ") and "\n" not in line, line
    assert len(line) < 400 and "pydantic" not in line
    assert list(tmp_path.iterdir()) == [], "half-written"


WHAT_TO_DO = [
    (lambda: b.record(box_scene(), contrast_threshold=0.3), "expected emulator={'emulator': 'esim', 'contrast_thresh"),
    (lambda: b.record(box_scene(), emulater="esim"), "expected 'emulator' (nearest)"),
    (lambda: b.record(box_scene(), labels="forward"), "expected a list of names of labels"),
    (lambda: b.record(box_scene(), labels=["flow"]), "expected 'forward', as in labels.flow of a YAML"),
    (lambda: b.render_frame(box_scene(), 0, ["flow_backward"]), "expected 'backward', as in labels.flow of a YAML"),
    (lambda: b.record("demo.yaml"), "expected a Scene, or what load(path) gives"),
    (lambda: b.generate(box_scene(), "/tmp/x", nums=3), "expected 'num' (nearest)"),
    (lambda: b.generate(box_scene()), "missing a required argument: 'out'; expected generate(source, out, "),
    (lambda: b.Mesh("none.glb"), "Mesh.file: no such file (got 'none.glb')"),
    (lambda: M("none.png"), "Material.image: no such file (got 'none.png')"),
    (lambda: M(np.full((4, 4, 3), 255.0)), "values beyond 1 (got 255.0); expected 0 to 1, or uint8 sRGB"),
    (lambda: M(colour=(1, 0, 0)), "expected 'color' (nearest)"),
    (lambda: P("cuboid", (0, 0, 1)), "too many positional arguments; expected Primitive(kind, material, pose, "),
    (lambda: blinkgl.Material(texture="a.png"), "Material.texture: has another name; expected image=…"),
    (lambda: P("cuboid", size=1), "expected one of extents"),
    (lambda: b.Pose(positions=(1, 2, 3)), "expected 'position' (nearest)"),
    (lambda: b.look_at((0, 0, 0)), "expected look_at(position, target)"),
    (lambda: C(pose=np.eye(4)), "Camera.pose: a matrix"),
    (lambda: C(fovy=60), "expected 'fov' (nearest)"),
    (lambda: b.Trajectory("none.txt"), "Trajectory.file: no such file"),
    (lambda: b.Light(environment={"map": "none.hdr"}), "Light.environment.map: no such file"),
    (lambda: S(durations=3), "expected 'duration' (nearest)"),
    (lambda: b.Timeline("uniform", framerate=100), "expected one of: fps, kind"),
    (lambda: b.Esim(4, 4, threshold=0.2), "expected 'contrast_threshold' (nearest)"),
    (b.Esim, "missing a required argument: 'height'"),
    (lambda: b.simulate("clip.mp4", fps=30), "of a file, simulate_file"),
    (lambda: b.simulate_file("clip.mp4", "a.h5", sensors="davis346"), "expected 'sensor' (nearest)"),
    (lambda: b.read_events("a.h5", t_start=3), "expected one of: path, truth"),
    (lambda: b.OnlineSequences("demo.yaml", window=3), "expected 'window_ms' (nearest)"),
]


@pytest.mark.parametrize("call, said", WHAT_TO_DO, ids=[str(k) for k in range(len(WHAT_TO_DO))])
def test_wrong_calls_say_what_to_do(call, said):
    """Unknown and missing arguments, too, end in a line that says what is called how."""
    with pytest.raises(BlinkGLError) as caught:
        call()
    assert said in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("argument", ["emulator", "images", "imu", "tracks"])
def test_a_message_offers_what_is_accepted(argument):
    with pytest.raises(blinkgl.ConfigError) as caught:
        blinkgl.simulate_sequence(box_scene(), **{argument: 3})
    names = str(caught.value).partition("expected ")[2].partition(", or a table")[0].split(", ")
    assert len(names) >= 2
    for name in names:
        with blinkgl.simulate_sequence(box_scene(), **{argument: name}):
            pass


# --- what changes its shape, and goes its way -------------------------------------------------------------------------


def test_what_lives_is_what_yaml_makes_of_it(tmp_path):
    """Figures in their coats on their ways, deformed primitives and triangles, clips of files: the tree of the YAML,
    and from it the same shapes and places."""
    (tmp_path / "arm.glb").write_bytes(arm_file().glb())
    b, file = blinkgl, str(tmp_path / "arm.glb")
    bodies = [
        b.Primitive("figure", clip="walk", coat=3, pose=b.Way([(4, 1, 0), (4, -2, 0)], start=0.1)),
        b.Primitive("cuboid", deform=b.Deform("twist", angle=40, along="x"), pose=(1, 0, 0)),
        b.Mesh(file, animation="wave", pose=(2, 0, 0)),
        b.Mesh(file, animation=b.Animation(0, speed=2, phase=0.3)),
        b.Mesh(file, deform=b.Deform("breathe", amount=(0.1, 0, -0.1))),
    ]
    scene = b.Scene(b.Camera(32, 24, pose=(-3, 0, 1)), bodies, duration=0.5)
    template = RunTemplate(yaml.safe_load(yaml.safe_dump(scene.template().tree)), tmp_path)
    config = template.sequence(0)
    ours, theirs = scene.build(config), build_scene(config.scene, config.camera, config.time.t0_ns, config.time.t1_ns)
    assert all(o.deforms for o in ours.objects)
    for a, c in zip(ours.objects, theirs.objects):
        for t in (0, 3 * 10**8):
            first, second = (o.parts[0].mesh.deformer.positions(o.parts[0].mesh, t) for o in (a, c))
            assert np.array_equal(first, second) and np.array_equal(a.path.pose(t), c.path.pose(t))
    walker = ours.objects[0]
    assert walker.parts[0].material.texture is not None, "wears its coat, and not white"
    moved = np.linalg.norm(walker.path.pose(10**9 // 2)[:3, 3] - walker.path.pose(0)[:3, 3])
    assert moved == pytest.approx(0.5 * walker.parts[0].mesh.deformer.speed, rel=1e-3)
    paint = b.Primitive("figure", material=b.Material(color=(1, 0, 0)))
    assert paint.material.tree["color"] == [1, 0, 0]


def test_a_closed_renderer_says_so():
    scene = blinkgl.Scene(blinkgl.Camera(32, 24)) + blinkgl.Primitive("sphere", pose=(3, 0, 0))
    renderer = blinkgl.Renderer(scene)
    renderer.close()
    renderer.close()
    for use in (renderer.luminance, renderer.image, renderer.frame):
        with pytest.raises(blinkgl.ConfigError) as error:
            use(0.1)
        assert str(error.value) == "Renderer: the renderer is closed; use it before close(), or make a new one"


def test_sides_are_what_the_file_says_unless_overruled(tmp_path):
    """A single-sided box around the camera, which shows its outside alone."""
    builder = GltfBuilder()
    builder.node(mesh=builder.mesh(*(lambda box: (box.vertices, box.faces))(trimesh.creation.box((6, 6, 6)))))
    (tmp_path / "box.glb").write_bytes(builder.glb())
    camera = blinkgl.Camera(16, 12)

    def seen(body, **keys):
        with blinkgl.Renderer(blinkgl.Scene(camera, **keys) + body) as renderer:
            return bool(np.isfinite(renderer.frame(0.1, ["depth"]).depth).all())

    for given, expected in ((None, False), (True, True), (False, False)):
        assert seen(blinkgl.Mesh(tmp_path / "box.glb"), both_sides=given) == expected
        painted = blinkgl.Mesh(tmp_path / "box.glb", material=blinkgl.Material(both_sides=given))
        assert seen(painted) == expected and seen(painted, both_sides=False if given else None) == expected
    box = trimesh.creation.box((6, 6, 6))
    for faces in (box.faces, box.faces[:, ::-1]):  # arrays do not say
        assert seen(blinkgl.Mesh(vertices=box.vertices, faces=faces))
    assert not seen(blinkgl.Primitive("cuboid", extents=(6, 6, 6)))
    with pytest.raises(
        blinkgl.ConfigError, match="double_sided: this key was removed .got True.; expected both_sides: true"
    ):
        blinkgl.Material(double_sided=True)


def test_a_scene_that_grows_checks_each_body_once(monkeypatch):
    checked = []
    own = blinkgl.Scene._checked
    monkeypatch.setattr(
        blinkgl.Scene,
        "_checked",
        lambda self, model, tree, **names: (
            checked.append(len(tree.get("objects", ()))) or own(self, model, tree, **names)
        ),
    )
    bodies = [
        blinkgl.Primitive("cuboid", pose=(k, 0, 5), material=blinkgl.Material(procedural="bricks")) for k in range(30)
    ]
    grown = blinkgl.Scene(blinkgl.Camera(64, 48), fog=(0.1, 0.2), gravity=(0, 0, -1))
    for body in bodies:
        grown += body
    assert max(checked) == 1
    assert grown.tree == blinkgl.Scene(blinkgl.Camera(64, 48), bodies, fog=(0.1, 0.2), gravity=(0, 0, -1)).tree
    assert grown.template().tree["scene"]["objects"][29]["name"] == "cuboid#29"


@pytest.mark.parametrize(("options", "said"), [({"world": 0}, "world: not a whole number"), ({"rank": 1}, "rank: ")])
def test_no_processes_are_not_one(options, said):
    with pytest.raises(ConfigError, match=said):
        blinkgl.OnlineSequences("demo", **options)


def test_numbers_of_numpy_and_beyond_all_floats():
    assert labels_tree([np.float32(0.5), np.float64(0.25)])["flow"] == [0.25, 0.5]
    with pytest.raises(ConfigError, match="not a finite number"):
        blinkgl.read_trajectory("way.txt", rate=10**400)
