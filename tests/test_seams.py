"""What BlinkGL says can be added from outside is added here, from outside: nothing but this file knows of it."""

import ast
import inspect
import json
import re
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import yaml
from plugged import forget_label
from pydantic import Field

from blinkgl.cli import run
from blinkgl.config.events import EmulatorConfig
from blinkgl.config.run import RunTemplate, load_run
from blinkgl.config.sequence import LabelsConfig
from blinkgl.dataset.explain import explain
from blinkgl.dataset.generate import generate_run
from blinkgl.events import Emulator, Events, register
from blinkgl.events.response import Response
from blinkgl.events.table import EMULATORS
from blinkgl.gl import ShaderError, create_context
from blinkgl.io.formats import open_events
from blinkgl.labels import (
    LABELS,
    Label,
    LabelRequest,
    register as register_label,
)
from blinkgl.labels.files import npy
from blinkgl.render.casting import scene_parts
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import build_scene

# --- an emulator (examples/plugins/mine.py has this class) ------------------------------------------------------------


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
        self.config = config
        self._level, self._free_ns = np.zeros(height * width, np.float32), np.zeros(height * width, np.int64)

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
        times, polarity = np.full(len(fires), t_ns // 1000), (moved[fires] > 0).astype(np.uint8)
        return Events(x.astype(np.uint16), y.astype(np.uint16), times, polarity)

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
    del EMULATORS["toy"], EmulatorConfig.members["toy"]


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


def test_the_plugin_of_the_page_has_this_toy():
    text = (Path(__file__).parents[1] / "examples/plugins/mine.py").read_text(encoding="utf-8")
    assert inspect.getsource(Toy) in text


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


BUILT_IN = list(EMULATORS)


def refused(emulator, match):
    with pytest.raises(TypeError, match=match):
        register(emulator)
    assert list(EMULATORS) == list(EmulatorConfig.members) == BUILT_IN, "nothing is half registered"


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


# --- a label (examples/own_label.py has nearly this class) ----------------------------------------------------------


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


class Counted(Position):
    dtype, channels = np.uint16, None


@pytest.mark.parametrize("dtype", [np.uint8, np.int64, np.uint16])
def test_numbers_of_a_label_are_stored_in_its_type_or_refused(dtype):
    label, value = Counted(), np.full((2, 3), 7, dtype)
    assert label.wrong(value, 2, 3) is None and label.own(value).dtype == np.uint16
    wide = np.array([[0, 65_536]])
    assert label.wrong(wide, 1, 2) == "0 to 65536 and not 0 to 65535" and label.wrong(-wide, 1, 2)


PLAIN = {**SMALL, "events": {"emulator": "esim"}, "labels": {"position": True, "depth": True}}


@pytest.fixture
def position():
    yield register_label(Position())
    forget_label("position")


def labelled(folder, **changes):
    return written(folder, **{**PLAIN, **changes})


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


def test_a_toy_label_is_explained(position, tmp_path, capsys):
    assert run(["explain", str(labelled(tmp_path))]) == 0
    assert "position" in capsys.readouterr().out
    with_it, without = (explain(load_run(labelled(tmp_path), [f"labels.position={on}"])) for on in ("true", "false"))
    assert (
        next(p.why for p in with_it.passes if p.name == "labels") == "depth, flow_forward, occlusion_forward, position"
    )
    assert not any(what == "position" for what, _ in with_it.left_out)
    assert ("position", "labels.position: false") in without.left_out


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


def test_the_page_leads_to_a_whole_label():
    """The example is run by test_examples.py."""
    text = (Path(__file__).parents[1] / "docs" / "extending.md").read_text(encoding="utf-8")
    assert "(examples.md#own_label)" in text.partition("## A label")[2].partition("\n## ")[0]
    example = (Path(__file__).parents[1] / "examples" / "own_label.py").read_text(encoding="utf-8")
    shown = {"__name__": __name__}
    exec(example, shown)
    assert shown["Position"]().name == Position().name


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
            "label 'copy': `name` cannot be a key",
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
        forget_label("position")
        renderer.forget()
