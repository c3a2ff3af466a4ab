"""What BlinkGL says can be added from outside is added here, from outside: nothing but this file knows of it."""

import ast
import inspect
import json
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
import yaml
from pydantic import Field

import blinkgl
from blinkgl.cli import run
from blinkgl.config.events import EmulatorConfig, EsimConfig
from blinkgl.config.sequence import SequenceConfig, load_run
from blinkgl.dataset.generate import generate_run
from blinkgl.errors import ConfigError
from blinkgl.events import Emulator, Esim, Events, emulator_of, make_emulator, register
from blinkgl.events.response import Response
from blinkgl.events.table import EMULATORS, unregister
from blinkgl.io.formats import open_events
from blinkgl.recordings.simulation import frames_to_events
from blinkgl.tools import fuzz_configs
from blinkgl.tools.config_docs import page
from blinkgl.trade.measure import Options
from blinkgl.trade.run import trade, write
from blinkgl.trade.settings import Setting

# --- an emulator (docs/extending.md shows this class) ---------------------------------------------------------------


class Toy(Emulator):
    """An ideal threshold with a fixed dead time: at most one event per pixel and frame, where ln(I + 0.01) has moved far enough."""

    class Config(EmulatorConfig):
        """A toy: an ideal threshold with a fixed dead time."""

        reconstructions = ("linear",)
        emulator: Literal["toy"] = "toy"
        contrast_threshold: float = Field(0.2, ge=0.01, le=10, description="ln units.")
        dead_us: float = Field(1000.0, ge=0, le=1e9, description="Dead time of a pixel after an event, microseconds.")

        @classmethod
        def from_sensor(cls, sensor):
            return {"contrast_threshold": sensor.contrast_threshold, "dead_us": sensor.refractory_us}

    _state = ("_level", "_free_ns")

    def __init__(self, height, width, config, seed=0, reconstruction="linear"):
        super().__init__(height, width, seed, reconstruction)
        self.config, self._level, self._free_ns = config, np.zeros(height * width, np.float32), np.zeros(height * width, np.int64)

    @classmethod
    def response(cls, config):
        return Response(config.contrast_threshold, 1.0, 0.01)

    @classmethod
    def noiseless(cls, config):
        return config

    def _start(self, frame, t_ns, rate):
        self._level[:], self._free_ns[:] = self._signal(frame), t_ns
        return Events.empty()

    def _advance(self, frame, t_ns, rate):
        moved = self._signal(frame) - self._level
        fires = np.flatnonzero((np.abs(moved) >= self.config.contrast_threshold) & (self._free_ns <= t_ns))
        self._level[fires] += moved[fires]
        self._free_ns[fires] = t_ns + round(1000 * self.config.dead_us)
        y, x = np.divmod(fires, self.width)
        return Events(x.astype(np.uint16), y.astype(np.uint16), np.full(len(fires), t_ns // 1000), (moved[fires] > 0).astype(np.uint8))

    def _signal(self, frame):
        return np.log((self._decode[frame] if frame.dtype == np.uint8 else frame) + np.float32(0.01))


SMALL = {
    "seed": 3, "camera": {"width": 64, "height": 48}, "time": {"duration": 0.1, "label_rate": 20},
    "scene": {"kind": "random", "objects": {"count": 3, "distance": [2, 4]}, "pool": {"primitives": ["cuboid", "sphere"], "variants": 2, "urdfs": False},
              "textures": {"procedural": ["checks", "fbm"], "variants": 2, "photographs": False, "max_size": 64}},
    "events": {"emulator": "toy", "dead_us": {"uniform": [100, 2000]}}, "preview": {"enabled": False},
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


@pytest.mark.parametrize("timeline", [{"kind": "displacement", "max_px": 1}, {"kind": "brightness", "max_fraction_of_threshold": 2}],
                         ids=lambda t: t["kind"])
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
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.roll(np.tile(np.arange(0, 256, 8, np.uint8), (24, 1)), 3 * k, axis=1))
    assert run(["simulate", str(tmp_path), "--fps", "100", "-o", str(tmp_path / "e.h5"), "-e", "toy", "--set", "dead_us=0"]) == 0
    assert "events in 0.05 s" in capsys.readouterr().out
    assert run(["simulate", str(tmp_path), "--fps", "100", "-o", str(tmp_path / "n.h5"), "-e", "toi"]) == 2
    assert "esim, v2e, voltmeter, toy" in capsys.readouterr().err
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
    settings = (Setting("displacement 2 px"), Setting("displacement 2 px", "pchip"))
    result = trade(load_run(written(tmp_path)), options=options, settings=settings)
    assert [s["name"] for s in result["settings"]] == ["displacement 2 px, linear, none"], "the toy follows straight lines alone"
    assert result["sizes"]["full"]["emulator"]["emulator"] == "toy" and result["sizes"]["full"]["levels"][0]["events"] > 0
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
        with pytest.raises(ConfigError, match=r"events.dead_us: too large \(got 2000000000.0\); expected a number from 0 to 1e.09"):
            load_run(written(tmp_path, **tree))
        with pytest.raises(ConfigError, match="events.dead: unknown key; expected 'dead_us' .nearest"):
            load_run(written(tmp_path, events={"emulator": "toy", "dead": 1}))
        with pytest.raises(ConfigError, match="toy follows straight lines alone .got 'pchip'.; expected linear, or events.emulator: esim"):
            load_run(written(tmp_path), ["timeline.reconstruction=pchip"])
        assert load_run(written(tmp_path), ["quality=fast"]).sequence(0).timeline.reconstruction == "linear"
        assert "## `events` with `emulator: toy`" in page()
        assert ("events", "dead_us") in set(fuzz_configs._paths(SequenceConfig))
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
    """No name of a kind is compared with or stands in a list or table; the models of the kinds are named where they are declared alone."""
    root = Path(blinkgl.__file__).parent
    models = {emulator.Config.__name__ for emulator in EMULATORS.values()}
    found = {}
    for path in root.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            here = {ast.Compare: lambda n: [n.left, *n.comparators], ast.Dict: lambda n: n.keys, ast.Tuple: lambda n: n.elts, ast.List: lambda n: n.elts,
                    ast.Set: lambda n: n.elts}.get(type(node), lambda n: [])(node)
            said = {n.value for n in here if isinstance(n, ast.Constant) and isinstance(n.value, str) and n.value in EMULATORS}
            if isinstance(node, ast.Name) and node.id in models:
                said.add(node.id)
            if said:
                found.setdefault(path.relative_to(root).as_posix(), set()).update(said)
    assert found.pop("config/sequence.py") == {"EsimConfig"}, "the default of `events:`"
    assert set(found) == {"config/events.py", *(f"events/{name}.py" for name in ("esim", "v2e", "v2e_model", "voltmeter", "reference"))}


# --- what is forgotten is named -------------------------------------------------------------------------------------


def toy_with(part, line=None):
    """The class above made anew from its source, one part ("Config.x": of its configuration) taken out or replaced by a line."""
    tree = ast.parse(inspect.getsource(Toy))
    body, name = tree.body[0].body, part
    if part.startswith("Config."):
        body, name = next(n for n in body if isinstance(n, ast.ClassDef)).body, part.removeprefix("Config.")
    named = lambda node: getattr(node, "name", None) or getattr(getattr(node, "target", None) or getattr(node, "targets", [None])[0], "id", None)
    (at,) = (k for k, node in enumerate(body) if named(node) == name)
    body[at:at + 1] = ast.parse(line).body if line else []
    made = {}
    exec(compile(tree, "toy", "exec"), {**globals()}, made)
    return made["Toy"]


def refused(emulator, match):
    with pytest.raises(TypeError, match=match):
        register(emulator)
    assert list(EMULATORS) == list(EmulatorConfig.members.models) == ["esim", "v2e", "voltmeter"], "nothing is half registered"


@pytest.mark.parametrize("part", ["Config", "Config.emulator", "Config.reconstructions", "Config.from_sensor", "response", "noiseless", "_start", "_advance"])
def test_a_part_that_is_forgotten_is_named(part):
    name = "Toy" if part in ("Config", "Config.emulator") else "'toy'"
    refused(toy_with(part), f"^emulator {name}: `{part}` is missing$")


FREE = "@classmethod\ndef {}(cls, _): return {}"


@pytest.mark.parametrize("part, line, problem", [
    ("Config", "Config = dict", "emulator Toy: `Config` is <class 'dict'> and not an EmulatorConfig of its own"),
    ("Config.emulator", "emulator: str = 'toy'", "emulator Toy: `Config.emulator` is not of the form"),
    ("Config.dead_us", "dead_us: float", "`Config` has keys without a default: dead_us"),
    ("Config.reconstructions", "reconstructions = 'linear'", "`Config.reconstructions` is 'linear' and not a tuple"),
    ("Config.reconstructions", "reconstructions = ('pchip',)", "not a tuple of 'linear' and"),
    ("Config.from_sensor", FREE.format("from_sensor", "3"), "`Config.from_sensor` gives 3 and not a table of keys"),
    ("Config.from_sensor", FREE.format("from_sensor", "{'dead': 1}"), "`Config.from_sensor` fails: dead: unknown key"),
    ("Config.from_sensor", FREE.format("from_sensor", "_.thresholds"), "`Config.from_sensor` fails: .*no attribute 'thresholds'"),
    ("response", FREE.format("response", "0.2"), "`response` gives 0.2 and not a Response"),
    ("noiseless", FREE.format("noiseless", "None"), "`noiseless` gives None and not the configuration of an emulator in the table"),
    ("Config.emulator", "emulator: Literal['v2e'] = 'v2e'", "emulator 'v2e': there is one already, V2e"),
])
def test_a_part_of_the_wrong_kind_is_named(part, line, problem):
    refused(toy_with(part, line), problem)


def test_only_emulators_are_registered_and_the_same_one_twice_does_no_harm():
    refused(dict, "<class 'dict'> is not a subclass of Emulator")
    register(Esim)
    refused(toy_with("Config.emulator", "emulator: Literal['esim'] = 'esim'"), "there is one already, Esim")
