"""``blinkgl import`` with Blender (extra [cycles]): scenes that Blender builds here, against what Blender itself makes
of them at each frame."""

from __future__ import annotations

import json
import os
import re
import subprocess
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from blinkgl import cli
from blinkgl.blender import process
from blinkgl.blender.importing import Imported, import_scene
from blinkgl.camera import PinHole
from blinkgl.scene.importing import gltf
from blinkgl.scene.motion.paths import StaticPath
from blinkgl.scene.worlds.from_file import from_document

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
        """(seconds since the first frame, what Blender saw)."""
        first = min(float(key.rpartition("@")[2]) for key in self.truth)  # FBX counts from one further
        for key, value in self.truth.items():
            owner, _, frame = key.rpartition("@")
            if owner == name:
                yield (float(frame) - first) / self.report.fps, value

    @property
    def tree(self) -> dict:
        return gltf.read(self.path).tree


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


def drawn(came: Came, camera: str | None = None):
    """What BlinkGL's own importer makes of it."""
    size, end = PinHole.centred(64, 48, 60.0), round(came.report.duration_s * NS)
    still = None if camera else StaticPath(np.eye(4), 0, end)
    return from_document(gltf.read(came.path), size, 0, end, camera_name=camera, camera_path=still)


def places(scene, name: str | None, t: float) -> np.ndarray:
    """(V, 3) of an object, or of all, in the world, as the renderer would draw it."""
    t_ns, found = round(t * NS), []
    for thing in scene.objects:
        if name in (None, thing.name):
            T = thing.path.pose(t_ns)
            for part in thing.parts:
                mesh = part.mesh
                at = mesh.vertices if mesh.deformer is None else mesh.deformer.positions(mesh, t_ns)
                found.append(at @ T[:3, :3].T + T[:3, 3])
    return np.concatenate(found)


def same_points(scene, came: Came, name: str) -> float:
    """Largest distance over the times, of each vertex from the one of Blender's that moves most like it."""
    seen = list(came.frames(name))
    ours, true = np.stack([places(scene, name, t) for t, _ in seen]), np.stack([points for _, points in seen])
    flat = [np.moveaxis(points, 1, 0).reshape(points.shape[1], -1) for points in (ours, true)]
    pairs = cKDTree(flat[1]).query(flat[0])[1]
    assert len(np.unique(pairs)) > 0.99 * len(np.unique(true[0].round(5), axis=0))
    return float(np.linalg.norm(ours - true[:, pairs], axis=2).max())


def same_clouds(ours: np.ndarray, true: np.ndarray) -> bool:
    return max(cKDTree(ours).query(true)[0].max(), cKDTree(true).query(ours)[0].max()) < 1e-5


def off_camera(scene, came: Came, name: str) -> float:
    """Largest difference of a pose from Blender's, whose cameras look along their -z."""
    turn = np.diag([1.0, -1, -1, 1])
    return max(np.abs(scene.camera_path.pose(round(t * NS)) @ turn - true).max() for t, true in came.frames(name))


# -------------------------------------------------------------------------------------------------------------- motion


def test_armature_shape_key_modifiers_camera_and_lights(imported):
    """Vertices of a bending, bulging, subdivided array and a camera's poses against Blender's evaluated depsgraph."""
    came = imported("dancer.blend")
    scene = drawn(came, "Eye")
    assert same_points(scene, came, "Ground") < 1e-6 and same_points(scene, came, "Row") < 1e-5
    assert off_camera(scene, came, "Eye") < 1e-5
    counts = {"meshes": 3, "skins": 1, "cameras": 1, "lights": 2, "animations": 1}
    assert counts.items() <= came.report.counts.items() and came.report.baked == ("Eye",) and not came.report.wrong
    lines = came.report.left_out
    assert len(lines) == 2 and "glTF has no area lights; left out: 'AREA'" in lines[0] and "'Checks'" in lines[1]
    assert (came.report.cameras, came.report.camera, came.report.frames) == (("Eye",), "Eye", (1, 24))
    assert came.report.duration_s == pytest.approx(23 / 24) and came.report.fps == 24
    lights = came.tree["extensions"]["KHR_lights_punctual"]["lights"]
    assert sorted(light["type"] for light in lights) == ["directional", "point"]


@pytest.mark.parametrize("name", ["dancer.blend", "mixamo.fbx", "formats.abc"])
def test_our_importer_plays_it(imported, name):
    """Skins, morph targets and their animations by BlinkGL's importer, against Blender at every frame."""
    came = imported(name)
    assert same_points(drawn(came), came, "Column") < 1e-5


def test_everything_that_moves_or_multiplies(imported):
    """Followed paths, aims, drivers, parents, instances, waves, rigid bodies, texts, booleans: all vertices
    together are Blender's, at every frame."""
    came = imported("world.blend")
    scene = drawn(came, "Cam")
    for t, true in came.frames("all"):
        assert same_clouds(places(scene, None, t), true)
    assert off_camera(scene, came, "Cam") < 1e-5
    assert came.report.baked == ("Wavy",)
    moved = {channel["target"]["node"] for channel in came.tree["animations"][0]["channels"]}
    still = {node["name"] for i, node in enumerate(came.tree["nodes"]) if i not in moved}
    assert {"Late", "Scatter"} <= still, "what does not move has no key frames"


def test_a_character_of_mixamo(imported):
    """FBX with bones mixamorig:*, a scale of 0.01 and y up: its clip plays, in metres, z up."""
    came = imported("mixamo.fbx")
    scene = drawn(came)
    first = places(scene, "Column", 0.0)
    assert np.ptp(first, axis=0) == pytest.approx([0.004, 0.0045, 0.0201], rel=0.05), "z up, a hundredth"
    assert same_points(scene, came, "Column") < 1e-5 * 0.02
    assert max(np.abs(places(scene, "Column", t) - first).max() for t in (0.3, 0.6)) > 0.2 * 0.02, "it moves"
    names = {node["name"] for node in came.tree["nodes"]}
    assert {"mixamorig:lower", "mixamorig:upper"} <= names and came.report.fps == 30


@pytest.mark.parametrize("rate", [60, 30])
@pytest.mark.parametrize("ending", ["usda", "usdc", "abc"])
def test_the_clock_of_a_format(imported, rate, ending):
    """The box is at x = 2 t by the file's own clock."""
    came = imported(f"rate{rate}.{ending}")
    assert not any("time codes" in line for line in came.report.left_out)
    document = gltf.read(came.path)
    made = from_document(document, PinHole.centred(8, 6, 6.0), 0, NS, camera_path=StaticPath(None, 0, NS))
    (box,) = made.objects
    for t in (0.0, 0.3, 0.5, 0.9):
        assert box.path.pose(int(t * NS))[0, 3] == pytest.approx(2 * t, abs=2e-3)
    assert came.report.fps == rate and came.report.duration_s == pytest.approx(1.0)
    # The option that the note of an unreadable clock names wins over the file's.
    assert imported(f"rate{rate}.{ending}", fps=12).report.fps == 12


STAGE = '#usda 1.0\n(\n    defaultPrim = "W"\n    {}\n    upAxis = "Z"\n)\n\n'
STAGE += 'def Xform "W"\n{{\n    custom double timeCodesPerSecond = 7\n}}\n'
CLOCKS = {
    "timeCodesPerSecond = 29.97": 29.97,
    "framesPerSecond = 30\n    timeCodesPerSecond = 48": 48.0,
    "framesPerSecond = 30": 30.0,  # which stands in for it
    "endTimeCode = 10": 24.0,  # the standard's default
}


def test_the_clock_of_usd_by_its_own_rules(tmp_path):
    program = ["import json, sys, bpy", f"sys.path[:0] = [{str(Path(process.__file__).with_name('inside'))!r}]"]
    program += ["from pathlib import Path", "from rates import rate_of"]
    program += ["site = Path(bpy.utils.resource_path('LOCAL'), 'python/lib/python3.11/site-packages')"]
    program += ["print(json.dumps([rate_of(Path(one), site) for one in sys.argv[1:]]))"]
    files, due = [], []
    for k, (settings, rate) in enumerate(CLOCKS.items()):
        for ending in ("usda", "usd", "usdz"):
            files.append(str(tmp_path / f"{k}.{ending}"))
            due.append(rate)
            if ending == "usdz":
                with zipfile.ZipFile(files[-1], "w") as archive:
                    archive.writestr("root.usda", STAGE.format(settings))
                    archive.writestr("other.usda", "#usda 1.0\n(\n timeCodesPerSecond = 5\n)\n")
            else:
                Path(files[-1]).write_text(STAGE.format(settings))
    for name, data in (("broken.usdc", b"PXR-USDC\0\10"), ("broken.usdz", b"PK"), ("a.fbx", b"Kaydara")):
        (tmp_path / name).write_bytes(data)
        files.append(str(tmp_path / name))
        due.append(None)
    command = [process.interpreter(), "-c", "\n".join(program), *files]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    assert [None if one is None else round(one, 6) for one in json.loads(done.stdout.splitlines()[-1])] == due


def test_what_the_door_does_not_draw_is_named(imported):
    came = imported("doors.blend")
    lines = "; ".join(came.report.left_out)
    for words in (
        "orthographic and panoramic cameras are not drawn; left out: 'Plan'",
        "the light of the world 'Evening' is left out",
        "pixels are square: their aspect of 2 : 1 is left out",
        "materials without a plain colour or image look different (bake them in Blender): 'Data'",
    ):
        assert words in lines
    assert came.report.cameras == ("Eye",) and came.report.camera is None
    document = gltf.read(came.path, lights=True)
    scene = from_document(document, PinHole.centred(8, 6, 6.0), 0, NS, camera_name="Eye", lights_gain=1.0)
    (lamp,) = scene.light.lamps  # hard: inner and outer cone are one
    assert lamp.kind == "spot" and lamp.inner == pytest.approx(lamp.outer)
    scale, offset = lamp.cone
    assert scale * np.cos(lamp.outer + 0.01) + offset < 0 and scale * np.cos(lamp.outer - 0.01) + offset > 1


@pytest.mark.parametrize("name", ["formats.usdc", "formats.abc"])
def test_other_formats(imported, name):
    """Vertices at every frame, of a skinned column (Alembic: a cache of vertices) and of a moving box."""
    came = imported(name)
    scene = drawn(came)
    for (t, column), (_, box) in zip(came.frames("Column"), came.frames("Box")):
        assert same_clouds(places(scene, None, t), np.concatenate([column, box]))


def linear(texels: np.ndarray) -> np.ndarray:
    c = texels / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def test_base_colours(imported):
    """Colours and pictures come as they are; of anything else a line says so."""
    came = imported("paints.blend")
    paint = {thing.name: thing.parts[0].material for thing in drawn(came).objects}
    assert paint["Plain"].base_color == pytest.approx((0.8, 0.1, 0.1), abs=1e-5)
    np.testing.assert_allclose(paint["Picture"].texture.image[10, :, 0], np.round(255 * np.arange(64) / 63), atol=1)
    assert paint["Glow"].unlit or max(paint["Glow"].emission) > 0
    (line,) = came.report.left_out
    assert line.startswith("materials without a plain colour or image") and line.endswith(": 'Pattern'")


# ----------------------------------------------------------------------------------------------------- what cannot come


def test_what_cannot_come_is_said(imported):
    came = imported("left_out.blend")
    lines = "; ".join(came.report.left_out)
    for words in (
        "glTF has no volumes; left out: 'Smoke'",
        "glTF has no area lights; left out: 'Panel'",
        "'Fish'",
        "'Hairy'",
    ):
        assert words in lines
    assert "Hidden" not in {node["name"] for node in came.tree["nodes"]}


def test_what_gltf_cannot_say_is_baked(imported):
    """Everything but the figure that is not to be seen yet, at whole and half frames."""
    came = imported("unsaid.blend")
    scene, moments = drawn(came, "Eye"), list(came.frames("all"))
    for t, true in moments:
        ours = np.concatenate(
            [part for part in (places(scene, o.name, t) for o in scene.objects) if np.ptp(part) > 1e-6]
        )
        off = max(cKDTree(ours).query(true)[0].max(), cKDTree(true).query(ours)[0].max())
        assert off < 2e-4 * np.ptp(true, axis=0).max(), (t, off)
    assert off_camera(scene, came, "Eye") < 1e-3
    assert {"Thick", "Both", "Column", "Spin", "Comes", "Trunk", "Ring"} <= set(came.report.baked)
    assert came.report.wrong == () and came.report.baked_mb < 2
    times = [came.tree["accessors"][s["input"]]["max"][0] for s in came.tree["animations"][0]["samplers"]]
    assert max(times) == pytest.approx(came.report.duration_s, rel=1e-6) == pytest.approx(7 * 1.001 / 30)


@pytest.mark.parametrize("shot", [(1, 3), (4, 8)])
def test_cuts_outside_the_range_are_none(imported, shot):
    assert not [line for line in imported("named.blend", frames=shot).report.left_out if "cuts between" in line]


def test_what_cannot_be_baked_is_named(imported, scenes, tmp_path, capsys):
    came = imported("named.blend", bake_mb=1.0)
    wrong, left = came.report.wrong, "\n".join(came.report.left_out)
    assert re.match(r"'Builds' .* for 0\.\d+ of 0.29 s \(its faces change, \d+% of the time\)", wrong[0])
    assert re.match(r"'Large' as glTF exports it is off by .* \(baked it would take more than \d+\.\d MB\)", wrong[1])
    for words in (
        "a unit of the scene is 0.01 m",
        "no number: 'Gone'",
        "invisible to the camera, or cut out of the picture: 'Shadow'",
        "in collections that are not rendered: 'Away'",
        "'Empty' cannot be exported, it is left out or plain (list index",
        "look different (bake them in Blender): 'Empty', 'Tiles'",
        "lights with key frames shine as at their brightest: 'Lamp'",
        "the scene cuts between cameras ('Left' from frame 1, 'Right' from frame 4)",
        "keyed lens keep that of the first frame: 'Right'",
        "the shift of the lens is left out: 'Right'",
        "drivers that need Python are not run: 'Python'",
    ):
        assert words in left
    assert came.tree["extensions"]["KHR_lights_punctual"]["lights"][0]["intensity"] == pytest.approx(8 * 683, rel=1e-3)
    assert {"Gone", "Shadow", "Away"}.isdisjoint(node["name"] for node in came.tree["nodes"] if "mesh" in node)
    assert cli.run(["import", str(scenes / "named.blend"), "--out", str(tmp_path / "out.glb"), "--bake-mb", "1"]) == 0
    report = capsys.readouterr().out.split("to play it:")[0]
    assert report.count("\n") <= 5 and "\nwrong: 'Builds'" in report and "\nmissing or different: " in report


def test_scripts_are_never_run(imported, scenes, capsys, tmp_path):
    """Neither by the import nor by what it reads back; both would run where they were allowed to (the control)."""
    assert (scenes / "control.txt").read_text() == "PWNED.text PWNED.driver"
    came = imported("evil.blend")
    assert not list(scenes.glob("PWNED*"))
    (thing,) = (thing for thing in drawn(came).objects if thing.name == "Thing")
    y = [thing.path.pose(round((f - 1) / 24 * NS))[1, 3] for f in (1, 10, 24)]
    assert y == pytest.approx([0.1, 1.0, 2.4], abs=1e-5), "a formula that needs no Python works"


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
        ("empty.blend", "the scene has no surface; expected a scene with a rendered mesh"),
        ("nothing_shown.blend", "the scene has no surface"),
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
