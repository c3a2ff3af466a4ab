"""What BlinkGL says can be added from outside is added here, from outside: nothing but this file knows of it."""

import ast
import inspect
import json
import re
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
import yaml
from pydantic import Field
from sources import parsed

import blinkgl
from blinkgl.cli import run
from blinkgl.config.events import EmulatorConfig, EsimConfig
from blinkgl.config.run import RunTemplate, load_run
from blinkgl.config.sequence import LabelsConfig, SequenceConfig
from blinkgl.dataset.explain import explain
from blinkgl.dataset.generate import generate_run
from blinkgl.errors import ConfigError
from blinkgl.events import Emulator, Esim, Events, emulator_of, make_emulator, register
from blinkgl.events.response import Response
from blinkgl.events.table import EMULATORS, unregister
from blinkgl.gl import ShaderError, create_context
from blinkgl.io.formats import open_events
from blinkgl.labels import (
    LABELS,
    Label,
    LabelFrame,
    LabelRequest,
    register as register_label,
    unregister as unregister_label,
)
from blinkgl.labels.files import npy
from blinkgl.recordings.simulation import frames_to_events
from blinkgl.render.casting import scene_parts
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import build_scene
from blinkgl.tools.config_docs import page
from blinkgl.tools.fingerprint import sums
from blinkgl.trade.measure import Options
from blinkgl.trade.run import trade, write
from blinkgl.trade.settings import Setting

# --- an emulator (docs/extending.md shows this class) ---------------------------------------------------------------


class Toy(Emulator):
    """An ideal threshold with a fixed dead time: at most one event per pixel and frame, where
    ln(I + 0.01) has moved far enough."""

    class Config(EmulatorConfig):
        """A toy: an ideal threshold with a fixed dead time."""

        emulator: Literal["toy"] = "toy"
        contrast_threshold: float = Field(0.2, ge=0.01, le=10, description="ln units.")
        dead_us: float = Field(1000.0, ge=0, le=1e9, description="Dead time of a pixel after an event, microseconds.")

        @classmethod
        def from_sensor(cls, sensor):
            return {"contrast_threshold": sensor.contrast_threshold, "dead_us": sensor.refractory_us}

    _state = ("_level", "_free_ns")

    def __init__(self, height, width, config, seed=0):
        super().__init__(height, width, seed)
        self.config, self._level, self._free_ns = (
            config,
            np.zeros(height * width, np.float32),
            np.zeros(height * width, np.int64),
        )

    @classmethod
    def response(cls, config):
        return Response(config.contrast_threshold, 1.0, 0.01)

    @classmethod
    def noiseless(cls, config):
        return config

    def _start(self, frame, t_ns):
        self._level[:], self._free_ns[:] = self._signal(frame), t_ns
        return Events.empty()

    def _advance(self, frame, t_ns):
        moved = self._signal(frame) - self._level
        fires = np.flatnonzero((np.abs(moved) >= self.config.contrast_threshold) & (self._free_ns <= t_ns))
        self._level[fires] += moved[fires]
        self._free_ns[fires] = t_ns + round(1000 * self.config.dead_us)
        y, x = np.divmod(fires, self.width)
        return Events(
            x.astype(np.uint16),
            y.astype(np.uint16),
            np.full(len(fires), t_ns // 1000),
            (moved[fires] > 0).astype(np.uint8),
        )

    def _signal(self, frame):
        return np.log((self._decode[frame] if frame.dtype == np.uint8 else frame) + np.float32(0.01))


SMALL = {
    "seed": 3,
    "camera": {"width": 64, "height": 48},
    "time": {"duration": 0.1, "label_rate": 20},
    "scene": {
        "kind": "random",
        "objects": {"count": 3, "distance": [2, 4]},
        "pool": {"primitives": ["cuboid", "sphere"], "variants": 2},
        "textures": {"procedural": ["checks", "fbm"], "variants": 2, "photographs": False, "max_size": 64},
    },
    "events": {"emulator": "toy", "dead_us": {"uniform": [100, 2000]}},
    "preview": {"enabled": False},
}


@pytest.fixture
def toy():
    register(Toy)
    yield Toy
    unregister("toy")


def written(folder, **changes):
    path = folder / "toy.yaml"
    path.write_text(yaml.safe_dump({**SMALL, **changes}))
    return path


@pytest.mark.parametrize(
    "timeline",
    [{"kind": "displacement", "max_px": 1}, {"kind": "brightness", "max_fraction_of_threshold": 2}],
    ids=lambda t: t["kind"],
)
def test_a_toy_emulator_is_generated_and_verified(toy, tmp_path, capsys, timeline):
    out = tmp_path / "out"
    (made,) = generate_run(load_run(written(tmp_path, timeline=timeline)), out)
    manifest = json.loads((made.path / "manifest.json").read_text())
    said = yaml.safe_load((made.path / "config.yaml").read_text())["events"]
    assert manifest["emulator"] == said["emulator"] == "toy" and 100 < said["dead_us"] < 2000
    events = open_events(made.path / "events.h5").read()
    assert len(events) == made.events > 1000
    by_pixel = np.lexsort((events.t, events.x, events.y))
    same = (np.diff(events.x[by_pixel].astype(int)) == 0) & (np.diff(events.y[by_pixel].astype(int)) == 0)
    assert np.diff(events.t[by_pixel])[same].min() >= int(said["dead_us"]), "no emulator but the toy has this dead time"
    assert run(["verify", str(out), "--deep"]) == 0, capsys.readouterr()


def test_a_toy_emulator_is_explained(toy, tmp_path, capsys):
    assert run(["explain", str(written(tmp_path, events={"emulator": "toy", "dead_us": 0}))]) == 0
    said = capsys.readouterr().out
    assert "toy; about" in said and "toy: dead_us" in said


def test_a_toy_emulator_simulates(toy, tmp_path, capsys):
    for k in range(6):
        cv2.imwrite(
            str(tmp_path / f"{k}.png"), np.roll(np.tile(np.arange(0, 256, 8, np.uint8), (24, 1)), 3 * k, axis=1)
        )
    assert (
        run(
            ["simulate", str(tmp_path), "--fps", "100", "-o", str(tmp_path / "e.h5"), "-e", "toy", "--set", "dead_us=0"]
        )
        == 0
    )
    assert "events in 0.05 s" in capsys.readouterr().out
    assert run(["simulate", str(tmp_path), "--fps", "100", "-o", str(tmp_path / "n.h5"), "-e", "toi"]) == 2
    told = capsys.readouterr().err
    assert "esim, v2e, voltmeter" in told and ", toy" in told
    from blinkgl.show.simulate import emulator_options

    assert emulator_options("toy", None, [], "davis346")["emulator"] == Toy.Config(contrast_threshold=0.2, dead_us=500)
    frames = [np.full((3, 4), level, np.float32) for level in (0.1, 0.2, 0.4)]
    assert sum(len(e) for e in frames_to_events(frames, fps=1000, emulator="toy")) == 24
    assert sum(len(e) for e in frames_to_events(frames, fps=1000, emulator=Toy.Config(dead_us=1500))) == 12


def test_a_sensor_sets_a_toy_emulator(toy, tmp_path):
    path = written(tmp_path, sensor="davis346", events={"emulator": "toy"}, camera={})
    config = load_run(path).sequence(0)
    assert (config.camera.width, config.events) == (346, Toy.Config(contrast_threshold=0.2, dead_us=500))
    assert load_run(path, ["events.dead_us=7"]).sequence(0).events == Toy.Config(contrast_threshold=0.2, dead_us=7)


def test_a_toy_emulator_is_traded(toy, tmp_path):
    options = Options(clip_s=0.02, tiles=(2, 2, 16, 12), levels=((2, 0.5),), rounds=1)
    settings = (Setting("displacement 2 px"),)
    result = trade(load_run(written(tmp_path)), options=options, settings=settings)
    assert [s["name"] for s in result["settings"]] == ["displacement 2 px, none"]
    assert (
        result["sizes"]["full"]["emulator"]["emulator"] == "toy" and result["sizes"]["full"]["levels"][0]["events"] > 0
    )
    write(result, tmp_path / "trade")
    assert "Events by TOY without noise" in (tmp_path / "trade" / "trade.html").read_text()


def test_the_configuration_knows_a_toy_emulator_while_it_is_registered(tmp_path):
    """The models were made before the toy was, and are the same afterwards."""
    before, schema = page(), SequenceConfig.model_json_schema()
    tree = {"events": {"emulator": "toy", "dead_us": {"uniform": [0, 2e9]}}}
    with pytest.raises(ConfigError, match="unknown choice .*'toy'.*'esim', 'v2e', 'voltmeter'"):
        load_run(written(tmp_path, **tree))
    register(Toy)
    try:
        with pytest.raises(
            ConfigError, match=r"events.dead_us: too large \(got 2000000000.0\); expected a number from 0 to 1e.09"
        ):
            load_run(written(tmp_path, **tree))
        with pytest.raises(ConfigError, match="events.dead: unknown key; expected 'dead_us' .nearest"):
            load_run(written(tmp_path, events={"emulator": "toy", "dead": 1}))
        assert "## `events` with `emulator: toy`" in page()
        assert "toy" in SequenceConfig.model_json_schema()["properties"]["events"]["discriminator"]["mapping"]
    finally:
        unregister("toy")
    assert page() == before and SequenceConfig.model_json_schema() == schema


def test_the_page_shows_this_toy():
    text = (Path(__file__).parents[1] / "docs" / "extending.md").read_text(encoding="utf-8")
    assert inspect.getsource(Toy) in text
    shown = {"__name__": __name__}
    exec(text.partition("```python\n")[2].partition("```")[0].replace("register(Toy)", ""), shown)
    assert shown["Toy"].Config().dead_us == 1000


def test_the_command_line_names_every_emulator(capsys):
    assert run(["simulate", "--help"]) == 0
    said = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert all(kind in said for kind in EMULATORS)


def test_the_table_is_whole():
    """What is in the one of classes is in the one of configurations."""
    assert list(EMULATORS) == list(EmulatorConfig.members.models) == ["esim", "v2e", "voltmeter"]
    for kind, emulator in EMULATORS.items():
        assert emulator.Config is EmulatorConfig.members.models[kind] and emulator_of(emulator.Config()) is emulator
        assert type(make_emulator(emulator.Config(), 3, 4)) is emulator
        assert type(emulator.noiseless(emulator.Config())) is EsimConfig
    with pytest.raises(TypeError, match="no emulator for Config"):
        make_emulator(Toy.Config(), 3, 4)


def test_nothing_else_asks_which_kind_an_emulator_is():
    """No name of a kind is compared with or stands in a list or table; the models of the kinds
    are named where they are declared alone."""
    models = {emulator.Config.__name__ for emulator in EMULATORS.values()}
    found = {}
    for path, nodes in parsed("blinkgl", words=(*EMULATORS, *models)):
        for node in nodes:
            here = {
                ast.Compare: lambda n: [n.left, *n.comparators],
                ast.Dict: lambda n: n.keys,
                ast.Tuple: lambda n: n.elts,
                ast.List: lambda n: n.elts,
                ast.Set: lambda n: n.elts,
            }.get(type(node), lambda n: [])(node)
            said = {
                n.value
                for n in here
                if isinstance(n, ast.Constant) and isinstance(n.value, str) and n.value in EMULATORS
            }
            if isinstance(node, ast.Name) and node.id in models:
                said.add(node.id)
            if said:
                found.setdefault(path.removeprefix("blinkgl/"), set()).update(said)
    assert found.pop("config/sequence.py") == {"EsimConfig"}, "the default of `events:`"
    assert set(found) == {
        "config/events.py",
        *(f"tensors/{name}.py" for name in ("esim", "v2e")),
        *(f"events/{name}.py" for name in ("esim", "v2e", "v2e_model", "voltmeter")),
    }


# --- what is forgotten is named -------------------------------------------------------------------------------------


def toy_with(part, line=None):
    """The class above made anew from its source, one part ("Config.x": of its
    configuration) taken out or replaced by a line."""
    tree = ast.parse(inspect.getsource(Toy))
    body, name = tree.body[0].body, part
    if part.startswith("Config."):
        body, name = next(n for n in body if isinstance(n, ast.ClassDef)).body, part.removeprefix("Config.")
    named = lambda node: (
        getattr(node, "name", None)
        or getattr(getattr(node, "target", None) or getattr(node, "targets", [None])[0], "id", None)
    )
    (at,) = (k for k, node in enumerate(body) if named(node) == name)
    body[at : at + 1] = ast.parse(line).body if line else []
    made = {}
    exec(compile(tree, "toy", "exec"), {**globals()}, made)
    return made["Toy"]


def refused(emulator, match):
    with pytest.raises(TypeError, match=match):
        register(emulator)
    assert list(EMULATORS) == list(EmulatorConfig.members.models) == ["esim", "v2e", "voltmeter"], (
        "nothing is half registered"
    )


@pytest.mark.parametrize(
    "part",
    [
        "Config",
        "Config.emulator",
        "Config.from_sensor",
        "response",
        "noiseless",
        "_start",
        "_advance",
    ],
)
def test_a_part_that_is_forgotten_is_named(part):
    name = "Toy" if part in ("Config", "Config.emulator") else "'toy'"
    refused(toy_with(part), f"^emulator {name}: `{part}` is missing$")


FREE = "@classmethod\ndef {}(cls, _): return {}"


@pytest.mark.parametrize(
    "part, line, problem",
    [
        ("Config", "Config = dict", "emulator Toy: `Config` is <class 'dict'> and not an EmulatorConfig of its own"),
        ("Config.emulator", "emulator: str = 'toy'", "emulator Toy: `Config.emulator` is not of the form"),
        ("Config.dead_us", "dead_us: float", "`Config` has keys without a default: dead_us"),
        ("Config.from_sensor", FREE.format("from_sensor", "3"), "`Config.from_sensor` gives 3 and not a table of keys"),
        (
            "Config.from_sensor",
            FREE.format("from_sensor", "{'dead': 1}"),
            "`Config.from_sensor` fails: dead: unknown key",
        ),
        (
            "Config.from_sensor",
            FREE.format("from_sensor", "_.thresholds"),
            "`Config.from_sensor` fails: .*no attribute 'thresholds'",
        ),
        ("response", FREE.format("response", "0.2"), "`response` gives 0.2 and not a Response"),
        (
            "noiseless",
            FREE.format("noiseless", "None"),
            "`noiseless` gives None and not the configuration of an emulator in the table",
        ),
        ("Config.emulator", "emulator: Literal['v2e'] = 'v2e'", "emulator 'v2e': there is one already, V2e"),
    ],
)
def test_a_part_of_the_wrong_kind_is_named(part, line, problem):
    refused(toy_with(part, line), problem)


def test_only_emulators_are_registered_and_the_same_one_twice_does_no_harm():
    refused(dict, "<class 'dict'> is not a subclass of Emulator")
    register(Esim)
    refused(toy_with("Config.emulator", "emulator: Literal['esim'] = 'esim'"), "there is one already, Esim")


# --- a label (docs/extending.md shows this class) -------------------------------------------------------------------


class Position(Label):
    """World-space position of the surface, (H, W, 3) float32 m; 0 where nothing is hit."""

    name, about = "position", "world-space position, m, float32 .npy"
    unit, buffer, varyings, channels = "m", "RGBA32F", ("local",), 3
    tolerance = 1e-4
    glsl = """
uniform mat4x3 world_from_local;

vec4 label_position()
{
    return vec4(world_from_local * vec4(local, 1.0), 1.0);
}
"""

    def uniforms(self, shot):
        return {"world_from_local": shot.moment.T_world_obj[:, :3]}

    def reference(self, scene, frame):
        out = np.zeros((*frame.hit.shape, 3))
        for number, (thing, _) in enumerate(scene_parts(scene)):
            on, pose = frame.part == number, thing.path.pose(frame.t_ns)
            out[on] = frame.local[on] @ pose[:3, :3].T + pose[:3, 3]
        return out


PLAIN = {**SMALL, "events": {"emulator": "esim"}, "labels": {"position": True, "depth": True}}


@pytest.fixture
def position():
    yield register_label(Position())
    unregister_label("position")


def labelled(folder, **changes):
    path = folder / "labelled.yaml"
    path.write_text(yaml.safe_dump({**PLAIN, **changes}))
    return path


@pytest.fixture
def made(position, tmp_path):
    """A data set with it, of one sequence."""
    for _ in generate_run(load_run(labelled(tmp_path)), tmp_path / "out"):
        pass
    return tmp_path / "out"


def seen_from(folder, k):
    """World positions of the pixels of label ``k`` from its depth and the camera's pose, (H, W, 3) float64."""
    depth, poses = np.load(folder / f"depth/{k:06d}.npy").astype(float), np.load(folder / "poses.npz")
    y, x = np.mgrid[: depth.shape[0], : depth.shape[1]]
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(poses["K"]).T
    T = poses["T_world_cam"][k + 1]  # the first is that of the pre-roll's start
    return np.where(
        np.isinf(depth)[..., None], 0, (rays * np.where(np.isinf(depth), 0, depth)[..., None]) @ T[:3, :3].T + T[:3, 3]
    )


def test_a_toy_label_is_generated_verified_shown_and_exported(made, capsys, tmp_path):
    folder = made / "train/sequence_000000"
    assert yaml.safe_load((folder / "config.yaml").read_text())["labels"]["position"] is True
    assert [p.name for p in sorted((folder / "position").iterdir())] == ["000000.npy", "000001.npy"]
    for k in range(2):
        there = np.load(folder / f"position/{k:06d}.npy")
        assert there.shape == (48, 64, 3) and there.dtype == np.float32
        np.testing.assert_allclose(there, seen_from(folder, k), atol=2e-3)
    assert run(["verify", str(made), "--deep"]) == 0, capsys.readouterr()
    assert run(["report", str(made)]) == 0
    assert "position" in re.findall(r'<img alt="([^"]*)"', (made / "report.html").read_text())
    (folder / "position/000001.npy").unlink()
    assert run(["verify", str(made)]) == 2
    assert "position/000001.npy: missing" in " ".join(capsys.readouterr().out.split())


def test_the_preview_of_a_toy_emulator_beside_a_toy_label(toy, position, tmp_path):
    """The events are in the pictures: with a dead time that leaves each pixel one, they look different."""
    labels, previewed = {"position": True}, {"enabled": True, "rate": 50.0}
    recipe = written(tmp_path, labels=labels, preview=previewed)
    (made,) = generate_run(load_run(recipe), tmp_path / "out")
    (silent,) = generate_run(load_run(recipe, ["events.dead_us=2e6"]), tmp_path / "silent")
    shown, without = (cv2.VideoCapture(str(one.path / "preview.mp4")) for one in (made, silent))
    pictures = 0
    while (frames := (shown.read(), without.read())) and frames[0][0]:
        (_, picture), (same_length, other) = frames
        assert same_length and picture.shape == other.shape
        differs = np.abs(picture.astype(int) - other).max(axis=2) > 60
        columns = np.flatnonzero(differs.any(axis=0))
        assert pictures == 0 or len(columns), "events of the toy are drawn"
        pictures += 1
    assert pictures == 8, "50 a second, of 0.1 s and the 0.05 s before the first label"
    assert made.events > 1.5 * silent.events


def test_a_toy_label_in_shards(position, made, tmp_path, monkeypatch):
    monkeypatch.setattr(Position, "shard", "position.npy")
    assert run(["export", str(made), "-o", str(tmp_path / "shards")]) == 0
    with tarfile.open(tmp_path / "shards/train-000000.tar") as tar:
        names = tar.getnames()
        assert sum(name.endswith(".position.npy") for name in names) == 2
        one = tar.extractfile("sequence_000000_000001.position.npy").read()
    assert one == (made / "train/sequence_000000/position/000001.npy").read_bytes()


def test_a_toy_label_is_explained(position, tmp_path, capsys):
    assert run(["explain", str(labelled(tmp_path))]) == 0
    assert "position" in capsys.readouterr().out
    with_it, without = (explain(load_run(labelled(tmp_path), [f"labels.position={on}"])) for on in ("true", "false"))
    assert (
        next(p.why for p in with_it.passes if p.name == "labels") == "depth, flow_forward, occlusion_forward, position"
    )
    assert not any(what == "position" for what, _ in with_it.left_out)
    assert ("position", "labels.position: false") in without.left_out


def test_a_toy_label_is_resumed(position, tmp_path):
    source, out = load_run(labelled(tmp_path)), tmp_path / "out"
    blinkgl.generate(source, out, num=2)
    whole = sums(out / "train")
    shutil.rmtree(out / "train/sequence_000001")
    blinkgl.generate(source, out, num=2, resume=True)
    assert sums(out / "train") == whole and sum(name.endswith("/position") for name in whole) == 2


def test_a_toy_label_at_the_front_door(position, tmp_path):
    source = load_run(labelled(tmp_path))
    recording = blinkgl.record(source, labels=["position", "flow"])
    assert (
        recording.labels[0].position.shape == (48, 64, 3)
        and recording.labels[0].depth is None
        and recording.images is None
    )
    blinkgl.generate(source, tmp_path / "door", labels=["position", "flow"])
    np.testing.assert_array_equal(
        np.load(tmp_path / "door/train/sequence_000000/position/000001.npy"), recording.labels[1].position
    )
    with blinkgl.Renderer(source) as renderer:
        frame = renderer.frame(0.05, ["position"])
    np.testing.assert_array_equal(frame.position, recording.labels[0].position)
    with pytest.raises(ConfigError, match="unknown label .got 'positoin'.; expected images, depth, .*, position"):
        blinkgl.record(source, labels=["positoin"])


@pytest.mark.parametrize("command", ["simulate", "trade"])
def test_what_has_no_labels_is_not_disturbed_by_one(command, position, tmp_path):
    if command == "trade":
        options = Options(clip_s=0.02, tiles=(2, 2, 16, 12), levels=((2, 0.5),), rounds=1)
        assert trade(load_run(labelled(tmp_path)), options=options, settings=(Setting("displacement 2 px"),))[
            "settings"
        ]
    else:
        assert (
            sum(
                len(e)
                for e in frames_to_events([np.full((3, 4), level, np.float32) for level in (0.1, 0.2, 0.4)], fps=1000)
            )
            > 0
        )


def shader(*arguments):
    return run(["shader", *map(str, arguments)])


def test_shader_diff_judges_a_toy_label(position, tmp_path, capsys, monkeypatch):
    path = labelled(tmp_path)
    assert shader("diff", path, "--pass", "position", "--json") == 0
    (report,) = json.loads(capsys.readouterr().out)["buffers"]
    assert (
        report["buffer"] == "position"
        and report["unit"] == "m"
        and report["value"] < 1e-4
        and report["off_silhouettes"]["pixels"] > 1000
    )
    assert shader("probe", path, "--pixel", "30,20") == 0
    assert re.search(r"^ *position +\S+  \S+  \S+", capsys.readouterr().out, re.M)
    for wrong, line in (("0.5 * world_from_local", "half the right value"), ("-world_from_local", "the sign is wrong")):
        monkeypatch.setattr(Position, "glsl", Position.glsl.replace("world_from_local *", f"{wrong} *"))
        assert shader("diff", path, "--pass", "position", "--pass", "depth") == 1
        said = capsys.readouterr().out
        assert "The first that is wrong: position" in said and line in said
        monkeypatch.undo()
    monkeypatch.setattr(Position, "glsl", Position.glsl.replace("local, 1.0", "locla, 1.0"))
    assert shader("diff", path, "--pass", "position") == 2
    assert re.match(r"error: include/labels/position.glsl:5: .*locla", capsys.readouterr().err)


def test_every_variant_of_a_toy_label_compiles(position, capsys):
    assert shader("check", "label.glsl", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["errors"] == [] and result["programs"]["label.glsl"] == 154


def test_only_what_is_asked_for_is_compiled(position, drawing):
    renderer, t_ns = drawing
    renderer.forget()
    renderer.gl.shaders.clear()
    renderer.labels(t_ns, LabelRequest("position"))
    assert {
        tuple(name for name, _ in defines if name.startswith("OUT_")) for _, defines in renderer.gl.shaders.compiled
    } == {("OUT_POSITION",)}


def test_the_configuration_knows_a_toy_label_while_it_is_registered(tmp_path):
    before, schema = page(), SequenceConfig.model_json_schema()
    with pytest.raises(ConfigError, match="labels.position: unknown key"):
        load_run(labelled(tmp_path))
    register_label(Position())
    try:
        assert (
            load_run(labelled(tmp_path)).sequence(0).labels.position is True
            and SequenceConfig().labels.position is False
        )
        with pytest.raises(ConfigError, match="labels.positoin: unknown key; expected 'position' .nearest"):
            load_run(labelled(tmp_path, labels={"positoin": True}))
        with pytest.raises(ConfigError, match="labels.position: not true or false .got 3"):
            load_run(labelled(tmp_path, labels={"position": 3}))
        assert "| `position` | true/false | `false` | world-space position, m, float32 .npy |" in page()
    finally:
        unregister_label("position")
    assert page() == before and SequenceConfig.model_json_schema() == schema


def test_the_page_shows_this_toy_label():
    text = (Path(__file__).parents[1] / "docs" / "extending.md").read_text(encoding="utf-8")
    assert inspect.getsource(Position) in text
    shown = {"__name__": __name__}
    block = text.partition("## A label")[2].partition("```python\n")[2].partition("```")[0]
    exec(block.replace("register(Position())", ""), shown)
    assert shown["Position"]().name == "position"


def test_reading_a_yaml_needs_neither_opengl_nor_a_compiler(tmp_path):
    (tmp_path / "a.yaml").write_text(yaml.safe_dump({"labels": {"depth": True, "flow": ["backward"]}}))
    code = (
        "import sys; from blinkgl.config.run import load_run; "
        "print(load_run(sys.argv[1]).sequence(0).labels.depth);assert not {'moderngl', 'numba', 'cv2', 'h5py', "
        "'blinkgl.gl', 'blinkgl.render'} & set(sys.modules), sorted(sys.modules)"
    )
    assert (
        subprocess.run(
            [sys.executable, "-c", code, str(tmp_path / "a.yaml")], capture_output=True, text=True, check=True
        ).stdout
        == "True\n"
    )


def test_nothing_else_lists_labels():
    """No name of a label is a key of a table or stands among others in a list, outside its own row
    and the keys of `labels:`: who needs some takes them from the table."""
    names = {*LABELS, "normals", "occlusion"} - {"images", "depth", "velocity"}  # words of other things, too
    found = {}
    for path, nodes in parsed("blinkgl", words=tuple(names)):
        for node in nodes:
            here = {
                ast.Dict: lambda n: n.keys,
                ast.Tuple: lambda n: n.elts,
                ast.List: lambda n: n.elts,
                ast.Set: lambda n: n.elts,
            }.get(type(node), lambda n: [])(node)
            said = {
                n.value for n in here if isinstance(n, ast.Constant) and isinstance(n.value, str) and n.value in names
            }
            if said:
                found.setdefault(path.removeprefix("blinkgl/"), set()).update(said)
    elsewhere = {
        path: said
        for path, said in found.items()
        if not path.startswith(("labels/", "config/labels", "shader_debugger/"))
    }
    assert elsewhere.pop("dataset/frames.py", elsewhere.pop("sequence/recorded.py", None)) == {
        "flow_forward",
        "occlusion_forward",
    }, "what recorded frames bring"
    assert {path for path in elsewhere if not path.startswith("scene/")} == set()  # a mesh has normals, too


def position_with(**changes):
    """The class above with parts replaced; None: taken out."""
    body = {
        name: value for name, value in vars(Position).items() if not name.startswith("__") or name == "__doc__"
    } | changes
    return type("Position", (Label,), {name: value for name, value in body.items() if value is not None})


def label_refused(label, match):
    known, keys = list(LABELS), list(LabelsConfig.model_fields)
    with pytest.raises(TypeError, match=match):
        register_label(label)
    assert list(LABELS) == known and list(LabelsConfig.model_fields) == keys, "nothing is half registered"


@pytest.mark.parametrize(
    "part, said",
    [
        ("name", "label None: `name` is not a word"),
        ("about", "label 'position': `about` is missing"),
        ("reference", "label 'position': `reference` is missing"),
        ("tolerance", "label 'position': `tolerance` is missing"),
        ("buffer", "label 'position': `buffer` is missing, and so is `finish`"),
        ("glsl", "label 'position': `glsl` is missing, and so is the file shaders/include/labels/position.glsl"),
    ],
)
def test_a_part_of_a_label_that_is_forgotten_is_named(part, said):
    label_refused(position_with(**{part: None})(), f"^{re.escape(said)}")


@pytest.mark.parametrize(
    "changes, said",
    [
        (dict(name="Position"), "`name` is not a word of a-z"),
        (dict(name="depth"), "label 'depth': `name` is taken"),
        (dict(name="float_flow"), "label 'float_flow': `name` is taken: `labels:` has such a key for something else"),
        (
            dict(name="copy", glsl=Position.glsl.replace("position", "copy")),
            "label 'copy': `name`: 'copy' cannot be a key",
        ),
        (dict(kind="vectors"), "`kind` is 'vectors' and none of scalar, depth"),
        (dict(buffer="RGB32F"), "`buffer` is 'RGB32F' and none of R32F, RG32F, RGBA32F, R32UI"),
        (dict(glsl="vec3 other()"), "`glsl` does not define label_position()"),
        (dict(varyings=("world",)), "`varyings` names others than local, normal"),
        (dict(needs=("dpeth",)), "`needs` names others than images, depth"),
        (dict(there=("depth",)), "`there` is said, but not `towards`"),
        (dict(forms=(npy("depth"),)), "`forms` writes where label 'depth' does: depth/000000.npy"),
    ],
)
def test_a_part_of_a_label_of_the_wrong_kind_is_named(changes, said):
    label_refused(position_with(**changes)(), re.escape(said))


def test_only_labels_are_registered():
    label_refused(Position, "`label` is no instance of Label")
    label_refused("position", "`label` is no instance of Label")
    with pytest.raises(KeyError, match="no label 'position'; there are images, depth"):
        LabelRequest("position")


@pytest.fixture(scope="module")
def drawing():
    """(renderer, time) of the small scene."""
    source = RunTemplate(PLAIN | {"labels": {}}, Path())
    config = source.sequence(0)
    with create_context() as gl:
        scene = build_scene(
            config.scene,
            config.camera,
            config.time.t0_ns,
            config.time.t1_ns,
            split="train",
            seed=config.seed,
            sequence=0,
            base=Path(),
        )
        with Renderer(gl, scene, config.render) as renderer:
            yield renderer, config.time.t0_ns


@pytest.mark.parametrize(
    "changes, error, said",
    [
        (dict(uniforms=None), TypeError, "label 'position': `uniforms` gives no 'world_from_local'"),
        (
            dict(uniforms=lambda self, shot: {"world_from_locla": shot.moment.T_world_obj[:, :3]}),
            TypeError,
            "label 'position': `uniforms` gives no 'world_from_local'",
        ),
        (
            dict(
                uniforms=lambda self, shot: {
                    "world_from_local": shot.moment.T_world_obj[:, :3],
                    "more": shot.moment.T_world_obj,
                }
            ),
            TypeError,
            "label 'position': `uniforms` gives 'more', which its `glsl` does not use",
        ),
        (
            dict(uniforms=lambda self, shot: {"world_from_local": np.eye(4)[:3]}),
            TypeError,
            "'world_from_local' of shape (3, 4), which does not begin with the",
        ),
        (
            dict(uniforms=lambda self, shot: {"mvp": shot.moment.mvp}),
            TypeError,
            "label 'position': `uniforms` gives 'mvp', which the pass gives, too",
        ),
        (
            dict(finish=lambda self, drawn: drawn.raw("position")),
            TypeError,
            "label 'position': `finish` gives (48, 64, 4) float32 and not (48, 64, 3) float32",
        ),
        (
            dict(finish=lambda self, drawn: drawn.raw("position")[..., :3] > 0),
            TypeError,
            "label 'position': `finish` gives (48, 64, 3) bool and not (48, 64, 3) float32",
        ),
        (
            dict(finish=lambda self, drawn: drawn.raw("depth")),
            TypeError,
            "label 'position': `finish` looks at 'depth', which is not among its `needs`",
        ),
        (
            dict(finish=lambda self, drawn: drawn.there("depth")),
            TypeError,
            "label 'position': `finish` looks at 'depth', which is not among its `there`",
        ),
        (dict(varyings=()), ShaderError, "include/labels/position.glsl:5: "),
        (dict(glsl=Position.glsl.replace("1.0);", "1.0)")), ShaderError, "include/labels/position.glsl:6: "),
    ],
)
def test_what_shows_only_when_a_label_is_drawn_is_named_then(changes, error, said, drawing):
    renderer, t_ns = drawing
    register_label(position_with(**changes)())
    try:
        with pytest.raises(error) as caught:
            renderer.labels(t_ns, LabelRequest("position"))
        assert said in str(caught.value)
    finally:
        unregister_label("position")
        renderer.forget()


def test_a_label_may_look_at_others_and_at_another_time(drawing):
    """How much nearer the surface is at its next place than what is seen there, (H, W): what occlusion is made of."""
    renderer, t_ns = drawing
    seen = {}

    def finish(self, drawn):
        seen.update(depth=drawn.raw("depth"), flow=drawn.value("flow_forward"), there=drawn.there("depth"))
        return drawn.raw("flow_forward")[..., 2]

    changes = dict(
        name="next_depth",
        buffer=None,
        glsl=None,
        uniforms=None,
        channels=0,
        finish=finish,
        towards="forward",
        needs=("depth", "flow_forward"),
        there=("depth",),
    )
    register_label(position_with(**changes)())
    try:
        later = t_ns + 10**7
        frame = renderer.labels(t_ns, LabelRequest("next_depth"), later)
        whole = renderer.labels(t_ns, LabelRequest("depth", "flow_forward", "next_depth"), later)
        for name, value in {
            "depth": np.where(seen["depth"] > 0, seen["depth"], np.inf),
            "next_depth": frame.next_depth,
        }.items():
            np.testing.assert_array_equal(getattr(whole, name), value)
        np.testing.assert_array_equal(whole.forward.flow, seen["flow"].flow)
        np.testing.assert_array_equal(
            np.where(seen["there"] > 0, seen["there"], np.inf), renderer.labels(later, LabelRequest("depth")).depth
        )
        with pytest.raises(TypeError, match="label 'next_depth' leads to another time: t_forward_ns"):
            renderer.labels(t_ns, LabelRequest("next_depth"))
    finally:
        unregister_label("next_depth")
    assert frame.next_depth is frame.values["next_depth"]
    with pytest.raises(AttributeError, match="no label 'next_depth'"):
        LabelFrame(0, {}).next_depth  # noqa: B018


@pytest.mark.parametrize(
    "reference, said",
    [
        (lambda self, scene, frame: frame.depth, "label 'position': `reference` gives (48, 64) and not (48, 64, 3)"),
        (
            lambda self, scene, frame: frame.deep,
            "label 'position': `reference` fails: 'ReferenceFrame' object has no attribute 'deep'",
        ),
    ],
)
def test_a_reference_that_is_none_is_named(reference, said, tmp_path, capsys):
    register_label(position_with(reference=reference)())
    try:
        assert run(["--debug", "shader", "diff", str(labelled(tmp_path)), "--pass", "position"]) == 1
        assert f"TypeError: {said}" in capsys.readouterr().err
    finally:
        unregister_label("position")
