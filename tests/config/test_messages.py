"""Errors in plain words: nothing of pydantic's vocabulary reaches a user, for every type of
error that the models can give."""

import re
import typing

import pytest
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from blinkgl.config import problems
from blinkgl.config.base import members
from blinkgl.config.problems import PROBLEMS, validate
from blinkgl.config.run import load_run
from blinkgl.config.sensor import SensorConfig
from blinkgl.config.sequence import SequenceConfig
from blinkgl.errors import ConfigError
from eflow.config import TrainConfig
from tests.refusals import refusal

ROOTS = (SequenceConfig, TrainConfig, SensorConfig)
FOREIGN = re.compile(
    r"input should|valid (dictionary|tuple|integer|number|string|boolean|list)|\btuple\b|\bdict\b|instance of"
    r"|unable to|pars(e|ing)|pydantic"
    r"|NoneType|[a-z]Config\b|extra input|field required|discriminator|\bstr\b|\bfloat\b|\bint\b|\bbool\b|not accepted$"
)
BAD = [
    None,
    True,
    7,
    -7,
    2.5,
    float("nan"),
    float("inf"),
    -1e30,
    1e30,
    10**30,
    "",
    "word",
    "9" * 5000,
    b"bytes",
    [],
    [1],
    [1, 2, 3, 4, 5],
    ["x"],
    [[1]],
    [None] * 3,
    {},
    {"x": 1},
    {1: 2},
    {"kind": "x"},
    {"kind": []},
    {"emulator": 3},
    {"name": None},
    {"preset": []},
    {"x": {"y": 1}},
    [{}],
    [{"x": 1}],
    {"a": {"x": 1}},
    1 + 2j,
]
EXPLICIT = {
    "kind": "explicit",
    "camera": {},
    "meshes": {"m": {"primitive": "cuboid"}},
    "materials": {"n": {}},
    "objects": [{"mesh": "m"}],
}
SEEDS = {
    SequenceConfig: [
        {},
        {"scene": EXPLICIT},
        {"scene": {"kind": "file", "path": "x"}},
        {"frames": {}},
        {"readout": {"events_per_second": 1e6}},
        *({"timeline": {"kind": k}} for k in ("uniform", "brightness")),
        *({"events": {"emulator": e}} for e in ("v2e", "voltmeter")),
    ],
    TrainConfig: [
        {"model": {"name": n}, "data": {"train": [{"path": "x"}]}}
        for n in ("eraft", "eflowformer", "ev_flownet", "spike_flownet", "ste_flownet")
    ],
    SensorConfig: [
        {
            "name": "x",
            "width": 3,
            "height": 3,
            "pixel_pitch_um": 1,
            "contrast_threshold": 0.2,
            "readout": {"events_per_second": 1e6},
        }
    ],
}


def places(annotation, path=()):
    """Every key of a model and of those below it."""
    for member in members(annotation):
        if isinstance(member, type) and issubclass(member, BaseModel):
            for name, info in member.model_fields.items():
                yield (*path, name)
                yield from places(info.annotation, (*path, name))
        elif typing.get_origin(member) is dict:
            yield from places(typing.get_args(member)[1], (*path, "m"))
        elif typing.get_origin(member) in (tuple, list):
            yield (*path, 0)
            for argument in typing.get_args(member):
                if argument is not Ellipsis:
                    yield from places(argument, (*path, 0))


def put(tree, path, value):
    """Copy of ``tree`` with ``value`` at ``path``; what is on the way is made."""
    if not path:
        return value
    if isinstance(path[0], int):
        return [put(tree[0] if isinstance(tree, list) and tree else {}, path[1:], value)]
    own = dict(tree) if isinstance(tree, dict) else {}
    return {**own, path[0]: put(own.get(path[0], {}), path[1:], value)}


@pytest.mark.parametrize("third", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
def test_every_error_of_every_key_is_plain(monkeypatch, third):
    """Of every value each key has a third, the next key the next one; `make slow` tries all with all."""
    seen: set[str] = set()
    original = problems._translate

    def spy(model, error: ValidationError, *rest):
        details: list[ErrorDetails] = error.errors(include_url=False)
        seen.update(d["type"] for d in details)
        return original(model, error, *rest)

    monkeypatch.setattr(problems, "_translate", spy)
    messages = 0
    for root in ROOTS:
        spots = sorted(set(places(root)), key=str) + [()]
        for tree in SEEDS[root]:
            some = spots if tree is SEEDS[root][0] else [p for p in spots if p and p[0] in {*tree} - {"data"}]
            for number, path in enumerate(some):
                for value in BAD[(number + third) % 3 :: 3]:
                    try:
                        validate(root, put(tree, path, value))
                    except ConfigError as error:
                        messages += 1
                        text = str(error)
                        said = re.sub(r"\(got .*\)(;|$)", r"\1", text)
                        assert "\n" not in text and len(text) < 600, text
                        assert not FOREIGN.search(said.replace("gl.backend", "")), (text, path, value)
                        assert error.where and (
                            not path or error.where.split(".")[0] in (*root.model_fields, "config")
                        ), (text, path, value)
    assert messages > 10_000 / 3
    spoken = set(PROBLEMS) | {"missing", "extra_forbidden", "value_error", "union_tag_invalid", "union_tag_not_found"}
    assert seen <= spoken, f"no plain words for {seen - spoken}"


@pytest.mark.parametrize(
    "text, message",
    [
        (
            "labels: {flow: both}",
            (
                "labels.flow: not a list (got 'both'); expected a list of 'forward' or 'backward', or a number, "
                "such as [forward]"
            ),
        ),
        ("labels: {semantics: {'': 1}}", "labels.semantics: not a pattern of names"),
        ("labels: {depth: maybe}", "labels.depth: not true or false (got 'maybe'); expected true or false"),
        ("scene: {region: 3}", "scene.region: not a table of keys (got 3); expected a table of keys"),
        (
            (
                "scene: {kind: explicit, objects: [{mesh: m}], meshes: {m: {primitive: cuboid}}, camera: {position: "
                "[1, 2]}}"
            ),
            "scene.camera.position: too few entries (got [1, 2])",
        ),
        (
            (
                "scene: {kind: explicit, objects: [{mesh: m}], meshes: {m: {primitive: cuboid}}, camera: {position: "
                "[1, 2, 3, 4]}}"
            ),
            "scene.camera.position: too many entries (got [1, 2, 3, 4]); expected a list of three numbers",
        ),
        ("scene: {kind: explicit}", "scene.objects: is required"),
        (
            "timeline: {fps: 100}",
            (
                "timeline.fps: unknown key; expected one of: kind, max_px, max_px_peak, max_step_us, "
                "min_step_us, percentile; it is a key of kind: uniform"
            ),
        ),
        ("events: {k1: 3}", "events.k1: unknown key; expected one of: causes, contrast_threshold"),
        (
            "timeline: {kind: regular}",
            ("timeline.kind: unknown choice (got 'regular'); expected one of 'uniform', 'displacement', 'brightness'"),
        ),
        (
            "events: {emulator: [esim]}",
            "events.emulator: unknown choice (got ['esim']); expected one of 'esim', 'v2e', 'voltmeter'",
        ),
        ("scene: {kind: file}", "scene.path: is required; expected text"),
        (
            "scene: {kind: file, path: x, camera: [1]}",
            "scene.camera: not accepted (got [1]); expected text, a whole number, or null",
        ),
        ("uniform: [1, 2]", "uniform: the whole file cannot be drawn"),
        ("choice: [{}, {seed: 3}]", "choice: the whole file cannot be drawn"),
        (
            "events: {emulator: voltmeter, preset: []}",
            "events.preset: unknown choice (got []); expected 'DVS346' or 'DVS240'",
        ),
        (
            "events: {emulator: v2e, preset: {a: 1}}",
            "events.preset: unknown choice (got {'a': 1}); expected 'default', 'clean' or 'noisy'",
        ),
        ("quality: [fast]", "quality: unknown choice"),
        ("sensor: [davis346]", "sensor: not text"),
        ("sensor: ''", "sensor: unknown sensor (got '')"),
        ("events: []", "events: not a table of keys"),
        ("{1: 2}", "config: a key is not text (got 1); expected text"),
        ("camera: {1: 2}", "camera: a key is not text (got 1); expected text"),
        ("output: {sequences: {integer: [1, 2]}}", "output: belongs to the whole run and cannot be drawn"),
        ("gl: {backend: {choice: [egl, osmesa]}}", "gl: belongs to the whole run and cannot be drawn"),
        (
            "frames: {fps: 1.0e-3, count: 6}",
            "frames.fps: 6 frames at this rate last 5000 s, more than the 4295.0 s that an event file can hold",
        ),
    ],
)
def test_messages(tmp_path, text, message):
    (tmp_path / "run.yaml").write_text(text)
    assert refusal(ConfigError, load_run, tmp_path / "run.yaml").startswith(message)


def test_numbers_that_python_will_not_print():
    for tree in (
        {"seed": 10**5000},
        {"camera": {"width": -(10**5000)}},
        {"camera": {"fov": 10**5000}},
        {"labels": {"flow": [10**5000]}},
    ):
        with pytest.raises(ConfigError, match="thousands of digits"):
            validate(SequenceConfig, tree)
