"""``blinkgl import`` with Blender (extra [cycles]): scenes that Blender builds here, against what Blender itself makes
of them at each frame."""

from __future__ import annotations

import os
import re
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from blinkgl import cli
from blinkgl.blender import process
from blinkgl.blender.importing import Imported, import_scene
from blinkgl.camera import PinHole
from blinkgl.config.deform import AnimationConfig
from blinkgl.errors import BlinkGLError
from blinkgl.scene.importing import gltf
from blinkgl.scene.importing.mesh_files import clip_of, load_asset
from blinkgl.scene.worlds.from_file import from_document
from gltf_at import Played

pytestmark = pytest.mark.skipif(bool(process.available()), reason=process.available() or "there")
BUILDER = Path(__file__).with_name("build_scenes.py")
NS = 1_000_000_000


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> Path:
    """A folder with what build_scenes.py makes, in one run of Blender."""
    folder = tmp_path_factory.mktemp("scenes")
    done = subprocess.run(
        [process.interpreter(), str(BUILDER), str(folder)], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0 and (folder / "future.blend").is_file(), done.stderr[-2000:]
    return folder


@dataclass
class Came:
    """One import: its report, the GLB, what Blender saw."""

    report: Imported
    path: Path
    truth: dict[str, np.ndarray]

    def frames(self, name: str):
        """(seconds since the first frame, what Blender saw, whether it is a frame of the file)."""
        first = min(float(key.rpartition("@")[2]) for key in self.truth)  # FBX counts from one further
        for key, value in self.truth.items():
            owner, _, frame = key.rpartition("@")
            if owner == name:
                t = (float(frame) - first) / self.report.fps
                yield t, value, float(frame) % 1 == 0


@pytest.fixture(scope="module")
def imported(scenes, tmp_path_factory):
    """``imported(file, **options)``, each once."""
    kept: dict = {}

    def get(name: str, **options) -> Came:
        key = name, tuple(sorted(options.items()))
        if key not in kept:
            out = tmp_path_factory.mktemp("out") / (name.replace(".", "_") + ".glb")
            report = import_scene(scenes / name, out, **options)
            truth = scenes / f"{name.split('.')[0]}.npz"
            stored = dict(np.load(truth, allow_pickle=False)) if truth.is_file() else {}
            kept[key] = Came(report, out, stored)
        return kept[key]

    return get


def drawn(came: Came, camera=None):
    """What BlinkGL's own importer makes of it."""
    size = PinHole.centred(64, 48, 60.0)
    return from_document(gltf.read(came.path), size, 0, round(came.report.duration_s * NS), camera_name=camera)


def places(scene, name: str, t: float) -> np.ndarray:
    """(V, 3) of an object in the world, as the renderer would draw it."""
    t_ns, found = round(t * NS), []
    for thing in scene.objects:
        if thing.name == name:
            T = thing.path.pose(t_ns)
            for part in thing.parts:
                mesh = part.mesh
                at = mesh.vertices if mesh.deformer is None else mesh.deformer.positions(mesh, t_ns)
                found.append(at @ T[:3, :3].T + T[:3, 3])
    return np.concatenate(found)


def same_points(at, came: Came, name: str, whole: bool = True) -> float:
    """Largest distance over the times, of each vertex from the one of Blender's that moves most like it."""
    seen = [(t, true) for t, true, full in came.frames(name) if full or not whole]
    ours, true = np.stack([at(t) for t, _ in seen]), np.stack([points for _, points in seen])
    flat = [np.moveaxis(points, 1, 0).reshape(points.shape[1], -1) for points in (ours, true)]
    pairs = cKDTree(flat[1]).query(flat[0])[1]
    assert len(np.unique(pairs)) > 0.99 * len(np.unique(true[0].round(5), axis=0))
    return float(np.linalg.norm(ours - true[:, pairs], axis=2).max())


# -------------------------------------------------------------------------------------------------------------- motion


def test_armature_shape_key_modifiers_camera_and_lights(imported):
    """Vertices of a bending, bulging, subdivided array and a camera's poses against Blender's evaluated depsgraph."""
    came = imported("dancer.blend")
    scene, played = drawn(came, "Eye"), Played(came.path)
    assert same_points(lambda t: played.positions("Column", t), came, "Column") < 1e-5
    assert same_points(lambda t: places(scene, "Ground", t), came, "Ground") < 1e-6
    for t, true, full in came.frames("Eye"):
        if full:
            ours = scene.camera_path.pose(round(t * NS)) @ np.diag([1.0, -1, -1, 1])
            assert np.abs(ours - true).max() < 1e-5
    assert same_points(lambda t: played.positions("Row", t), came, "Row") < 1e-5
    counts = {"meshes": 3, "skins": 1, "cameras": 1, "lights": 2, "animations": 1, "shapes baked frame by frame": 0}
    assert counts.items() <= came.report.counts.items()
    lines = came.report.left_out
    assert len(lines) == 2 and "area lights in glTF, left out: 'AREA'" in lines[0] and "'Checks'" in lines[1]
    assert (came.report.cameras, came.report.camera, came.report.frames) == (("Eye",), "Eye", (1, 24))
    assert came.report.duration_s == pytest.approx(23 / 24) and came.report.fps == 24
    lights = Played(came.path).tree["extensions"]["KHR_lights_punctual"]["lights"]
    assert sorted(light["type"] for light in lights) == ["directional", "point"]


def test_more_keys_are_exact_between_frames(imported):
    few, many = imported("dancer.blend"), imported("dancer.blend", keys_per_frame=8)
    error = {}
    for name, came in (("few", few), ("many", many)):
        played = Played(came.path)
        error[name] = same_points(lambda t, p=played: p.positions("Column", t), few, "Column", whole=False)
    assert error["few"] > 1e-3 and error["many"] < 1e-5
    assert many.report.duration_s == few.report.duration_s and many.report.fps == 24 and many.report.frames == (1, 24)
    apart = [np.abs(drawn(many, "Eye").camera_path.pose(round(t * NS)) @ np.diag([1.0, -1, -1, 1]) - true).max()
             for t, true, _ in few.frames("Eye")]  # fmt: skip
    assert max(apart) < 1e-5


@pytest.mark.parametrize("name", ["dancer.blend", "mixamo.fbx", "formats.abc"])
def test_our_importer_plays_it(imported, name):
    """Skins, morph targets and their animations by BlinkGL's importer, against Blender at every frame."""
    came = imported(name)
    scene = drawn_with_a_pose(came)
    assert same_points(lambda t: places(scene, "Column", t), came, "Column") < 1e-5


def test_a_part_of_the_range_at_another_tempo(imported):
    came = imported("dancer.blend", frames=(7, 13), fps=12.0)
    assert came.report.frames == (7, 13) and came.report.duration_s == pytest.approx(0.5)
    played, whole = Played(came.path), imported("dancer.blend").truth
    assert played.duration == pytest.approx(0.5, abs=1e-6)
    for frame in (7, 10, 13):
        true = whole[f"Column@{frame}"]
        assert cKDTree(true).query(played.positions("Column", (frame - 7) / 12))[0].max() < 1e-5


def test_everything_that_moves_or_multiplies(imported):
    """Followed paths, aims, drivers, parents, instances, waves, rigid bodies, texts, booleans: all vertices
    together are Blender's, at every frame."""
    came = imported("world.blend")
    played = Played(came.path)
    shown = [i for i, node in played.document.nodes.items() if node.mesh is not None]
    for t, true, _ in came.frames("all"):
        ours = np.concatenate([played.of(i, t) for i in shown])
        assert cKDTree(ours).query(true)[0].max() < 1e-5
        assert cKDTree(true).query(ours)[0].max() < 1e-5
    for t, true, _ in came.frames("Cam"):
        assert np.abs(played.camera("Cam", t) - true).max() < 1e-5
    assert came.report.counts["shapes baked frame by frame"] == 1
    still = {node.name for i, node in played.document.nodes.items() if not any(n == i for n, _ in played.moved)}
    assert {"Late", "Scatter"} <= still, "what does not move has no key frames"


def test_a_character_of_mixamo(imported):
    """FBX with bones mixamorig:*, a scale of 0.01 and y up: its clip plays, in metres, z up."""
    came = imported("mixamo.fbx")
    played = Played(came.path)
    first = played.positions("Column", 0.0)
    assert np.ptp(first, axis=0) == pytest.approx([0.004, 0.0045, 0.0201], rel=0.05), "z up, a hundredth"
    assert same_points(lambda t: played.positions("Column", t), came, "Column") < 1e-5 * 0.02
    assert max(np.abs(played.positions("Column", t) - first).max() for t in (0.3, 0.6)) > 0.2 * 0.02, "it moves"
    names = {node.name for node in played.document.nodes.values()}
    assert {"mixamorig:lower", "mixamorig:upper"} <= names and came.report.fps == 30


def test_a_clip_without_skin(imported):
    """Mixamo's "Without Skin": joints alone, whose clip moves the figure of another file."""
    figure, clip = imported("mixamo.fbx"), imported("mixamo_clip.fbx")
    assert clip.report.counts["meshes"] == 0 and clip.report.counts["animations"] == 1
    animation = AnimationConfig(file=str(clip.path), loop=False)
    parts = load_asset(figure.path, play=clip_of(animation, clip.path.parent)).parts

    def at(t: float) -> np.ndarray:
        return np.concatenate([p.mesh.deformer.positions(p.mesh, round(t * NS)) for p in parts])

    assert same_points(at, clip, "Column") < 1e-5 * 0.02
    own = cKDTree(figure.truth["Column@20"]).query(at(19 / 30))[0].max()
    assert own > 0.1 * 0.02, "not the figure's own clip"


def drawn_with_a_pose(came: Came):
    from blinkgl.scene.motion.paths import StaticPath

    end = round(came.report.duration_s * NS)
    still = StaticPath(np.eye(4), 0, end)
    return from_document(gltf.read(came.path), PinHole.centred(64, 48, 60.0), 0, end, camera_path=still)


@pytest.mark.parametrize("name", ["formats.usdc", "collada.dae", "formats.abc"])
def test_other_formats(imported, name):
    """Vertices at every frame, of a skinned column (Alembic: a cache of vertices) and of a moving box."""
    came = imported(name)
    played = Played(came.path)
    shown = [i for i, node in played.document.nodes.items() if node.mesh is not None]
    for (t, column, _), (_, box, _) in zip(came.frames("Column"), came.frames("Box")):
        ours = np.concatenate([played.of(i, t) for i in shown])
        true = np.concatenate([column, box])
        assert cKDTree(true).query(ours)[0].max() < 1e-5 and cKDTree(ours).query(true)[0].max() < 1e-5


def test_an_obj_is_its_meshes(imported):
    assert imported("still.obj").report.counts["meshes"] == 2


def test_cloth_comes_as_a_shape_a_frame(imported):
    came = imported("cloth.blend")
    assert came.report.counts["shapes baked frame by frame"] == 1
    played = Played(came.path)
    assert same_points(lambda t: played.positions("Sheet", t), came, "Sheet") < 1e-4
    assert np.ptp([played.positions("Sheet", t)[:, 2].mean() for t in (0.0, 0.4)]) > 0.05, "it falls"


def test_clips(imported):
    one, each = imported("left_out.blend"), imported("left_out.blend", clips=True)
    assert one.report.counts["animations"] == 1
    names = [animation["name"] for animation in Played(each.path).tree["animations"]]
    assert sorted(names) == ["rise", "slide"]


def linear(texels: np.ndarray) -> np.ndarray:
    c = texels / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def test_base_colours(imported):
    """Colours and pictures come as they are; of anything else a line says so."""
    came = imported("paints.blend")
    paint = {thing.name: thing.parts[0].material for thing in drawn_with_a_pose(came).objects}
    assert paint["Plain"].base_color == pytest.approx((0.8, 0.1, 0.1), abs=1e-5)
    np.testing.assert_allclose(paint["Picture"].texture.image[10, :, 0], np.round(255 * np.arange(64) / 63), atol=1)
    assert paint["Glow"].unlit or max(paint["Glow"].emission) > 0
    (line,) = came.report.left_out
    assert line.startswith("no plain colour and no picture") and line.endswith(": 'Pattern'")


# ----------------------------------------------------------------------------------------------------- what cannot come


def test_what_cannot_come_is_said(imported):
    came = imported("left_out.blend")
    lines = "; ".join(came.report.left_out)
    for words in (
        "no volumes in glTF, left out: 'Smoke'",
        "area lights in glTF, left out: 'Panel'",
        "no metaballs",
        "'Fish'",
        "'Hairy'",
    ):
        assert words in lines
    assert "Hidden" not in {node.name for node in Played(came.path).document.nodes.values()}


@pytest.mark.parametrize(
    "name, words",
    [
        ("keys_and_modifiers", "'Both' has shape keys and modifiers \\(Bevel\\), which glTF has not together"),
        ("at_vertices", "'Spots' shows others at its vertices or faces; expected real objects"),
        ("offset", "'One' shows a collection about a point of its own; expected an instance offset of 0"),
        ("builds", "'Builds' changes how many faces it has"),
    ],
)
def test_what_would_come_wrong_is_refused(scenes, tmp_path, name, words):
    with pytest.raises(BlinkGLError, match=words) as caught:
        import_scene(scenes / f"{name}.blend", tmp_path / "out.glb")
    assert "\n" not in str(caught.value) and os.listdir(tmp_path) == []


@pytest.mark.parametrize("option", ["--texture-size", "--bake-seconds"])
def test_options_that_are_gone_are_refused(scenes, tmp_path, capsys, option):
    assert cli.run(["import", str(scenes / "evil.blend"), "--out", str(tmp_path / "o.glb"), option, "64"]) == 2
    assert (
        capsys.readouterr().err == f"error: {option}: colours are no longer baked; expected colours baked in Blender\n"
    )


def test_scripts_are_never_run(imported, scenes, capsys, tmp_path):
    """Neither by the import nor by what it reads back; both would run where they were allowed to (the control)."""
    assert (scenes / "control.txt").read_text() == "PWNED.text PWNED.driver"
    came = imported("evil.blend")
    assert not list(scenes.glob("PWNED*"))
    node = Played(came.path)
    y = [node.world(node.node("Thing"), (f - 1) / 24)[2, 3] for f in (1, 10, 24)]
    assert -np.array(y) == pytest.approx([0.1, 1.0, 2.4], abs=1e-5), "a formula that needs no Python works"


def test_the_users_blender_is_not_asked(scenes, tmp_path, monkeypatch):
    """A start-up script that Blender's own variables lead to is not run."""
    mark, folder = tmp_path / "started", tmp_path / "scripts" / "startup"
    folder.mkdir(parents=True)
    (folder / "mine.py").write_text(f"open({str(mark)!r}, 'w').write('x')\ndef register(): pass\n")
    monkeypatch.setenv("BLENDER_SYSTEM_SCRIPTS", str(tmp_path / "scripts"))
    subprocess.run([process.interpreter(), "-c", "import bpy"], capture_output=True)
    assert mark.exists(), "the control: Blender alone runs it"
    mark.unlink()
    import_scene(scenes / "evil.blend", tmp_path / "out.glb")
    assert not mark.exists()


@pytest.mark.parametrize(
    "name, words",
    [
        ("empty.blend", "the scene shows no surface; expected a scene with a mesh"),
        ("nothing_shown.blend", "the scene shows no surface"),
        ("no_blender.blend", "Blender cannot read it"),
        ("future.blend", r"saved by Blender 9\.99, newer than the 4\.5 that would open it"),
        ("short.blend", "Blender cannot read it"),
        ("garbage.fbx", "Blender cannot read it"),
        ("garbage.usdc", "Blender cannot read it"),
        ("garbage.dae", "Blender cannot read it"),
        ("garbage.abc", "Blender cannot read it as ABC"),
    ],
)
def test_bad_files_are_one_line(scenes, tmp_path, name, words, capsys):
    assert cli.run(["import", str(scenes / name), "--out", str(tmp_path / "out.glb")]) == 2
    error = capsys.readouterr().err
    assert re.search(rf"^error: .*{name}: {words}", error) and error.count("\n") == 1, error
    assert os.listdir(tmp_path) == []


def test_a_scene_that_is_not_there(scenes, tmp_path):
    with pytest.raises(BlinkGLError, match="the file has no scene 'Attic'; expected one of: 'Scene'"):
        import_scene(scenes / "evil.blend", tmp_path / "out.glb", scene="Attic")
    assert os.listdir(tmp_path) == []


def test_to_a_data_set(scenes, tmp_path, monkeypatch, capsys):
    """The lines that the command prints make a data set."""
    monkeypatch.chdir(tmp_path)
    assert cli.run(["import", str(scenes / "dancer.blend"), "--out", "dancer.glb"]) == 0
    (tmp_path / "dancer.yaml").write_text(capsys.readouterr().out.split("to play it:\n")[1])
    small = ["--set", "camera.width=64", "--set", "camera.height=36", "--set", "timeline.fps=100"]
    assert (
        cli.run(["generate", "dancer.yaml", "--out", "data", "--num", "1", "--set", "timeline.kind=uniform", *small])
        == 0
    )
    assert cli.run(["verify", "data"]) == 0
