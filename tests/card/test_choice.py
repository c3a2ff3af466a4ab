"""``events.device``: who makes the events, what is refused, and that files are the same."""

from __future__ import annotations

import hashlib

import pytest
import yaml

import blinkgl
from blinkgl.card import CardEsim, choice
from blinkgl.config.events import EsimConfig, V2eConfig, VoltmeterConfig
from blinkgl.config.sequence import load_run
from blinkgl.errors import BlinkGLError, ConfigError, EventDataError, GLError
from blinkgl.events import Esim, make_emulator
from tests.events.clips import assert_same, random_clip, run


class Hardware:
    """A context as a graphics card's would look."""

    is_software = False

    def __init__(self, gl):
        self._gl = gl

    def __getattr__(self, name):
        return getattr(self._gl, name)


def made(gl, reconstruction="linear", **values):
    emulator = make_emulator(EsimConfig(**values), 16, 24, 1, reconstruction, gl)
    kind = type(emulator)
    emulator.release()
    assert emulator.device == {Esim: "cpu", CardEsim: "gl"}[kind]
    return kind


def test_auto_takes_a_graphics_card_that_can_do_it(gl, monkeypatch):
    card = Hardware(gl)
    assert made(gl) is Esim, "drawn by the processor"
    assert made(None) is Esim, "nothing is drawn"
    assert made(card) is CardEsim
    assert made(card, device="cpu") is Esim
    assert made(card, "pchip") is Esim
    assert made(card, threshold_jitter=4.0) is Esim
    assert made(gl, device="gl") is CardEsim
    assert make_emulator(VoltmeterConfig(), 16, 24, 1, "linear", card).device == "cpu"
    v2e = make_emulator(V2eConfig(), 16, 24, 1, "linear", card)
    assert v2e.device == "gl"
    v2e.release()
    monkeypatch.setattr(choice, "_answers", {})
    monkeypatch.setattr(choice, "_equal", lambda a, b: False)
    assert made(card) is Esim, "its events of the trial are others"
    with pytest.raises(GLError, match=r"^events\.device: the card's events of a trial are not .*events\.device: cpu"):
        made(gl, device="gl")


def test_auto_goes_back_to_the_processor_where_the_picture_is_too_large(gl, monkeypatch):
    assert choice.same_events(gl)
    card = Hardware(gl)
    monkeypatch.setattr("blinkgl.card.room.refuse_too_large", lambda *_: (_ for _ in ()).throw(GLError("too large")))
    assert made(card) is Esim
    with pytest.raises(GLError, match="too large"):
        made(gl, device="gl")


def test_without_a_context_the_emulator_has_its_own(gl):
    clip, times = random_clip(1, frames=3)
    card = blinkgl.Esim(37, 45, seed=3, device="gl")
    assert card.device == "gl" and card.gl is not gl
    assert_same(run(card, clip, times), run(blinkgl.Esim(37, 45, seed=3), clip, times))
    card.release()
    assert card.gl.released and not gl.released
    card.release()


TINY = {
    "preview": {"enabled": False},
    "camera": {"width": 48, "height": 32},
    "time": {"duration": 0.06, "label_rate": 50},
    "scene": {
        "kind": "random",
        "objects": {"count": 2, "distance": [2, 4]},
        "pool": {"primitives": ["cuboid"], "variants": 2, "urdfs": False},
        "textures": {"procedural": ["checks"], "variants": 2, "photographs": False, "max_size": 32},
        "camera_motion": {"speed": [2, 4], "rotation_rate": [60, 100]},
    },
}


def config_of(folder, **changes):
    path = folder / "run.yaml"
    path.write_text(yaml.safe_dump({**TINY, **changes}))
    return load_run(path).sequence(0)


@pytest.mark.parametrize(
    "emulator",
    [{}, pytest.param({"emulator": "v2e", "preset": "noisy", "causes": True}, marks=pytest.mark.slow)],
    ids=["esim", "v2e"],
)
def test_files_are_the_same_and_the_manifest_says_which(gl, tmp_path, monkeypatch, emulator):
    from blinkgl.dataset.generate import generate_sequence
    from blinkgl.dataset.verify import verify_dataset
    from blinkgl.render.canvas import Frame
    from blinkgl.sequence_files.sequence_dir import read_manifest

    viewed, view = [], Frame.view
    monkeypatch.setattr(Frame, "view", lambda frame, name="": viewed.append(frame) or view(frame, name))
    sums, said, read_back = {}, {}, {}
    for device in ("cpu", "gl", "auto", "card"):
        if device == "card":  # sorted there, read back one frame late
            monkeypatch.setattr(gl, "is_software", False)
        config = config_of(tmp_path, events={**emulator, "device": "auto" if device == "card" else device})
        viewed.clear()
        path = generate_sequence(config, 0, tmp_path / device, gl).path
        read_back[device] = len(viewed)
        said[device] = read_manifest(path)["events_device"]
        files = (p for p in path.rglob("*") if p.is_file() and p.name not in ("manifest.json", "config.yaml"))
        sums[device] = {p.relative_to(path).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}
    monkeypatch.undo()
    assert said == {"cpu": "cpu", "gl": "gl", "auto": "cpu", "card": "gl"}
    assert read_back["gl"] == read_back["card"] == 0 < read_back["cpu"], "event frames stay on the card"
    assert sums["cpu"] == sums["gl"] == sums["auto"] == sums["card"] and "events.h5" in sums["cpu"]
    result = verify_dataset(tmp_path / "gl", deep=1)
    assert result.clean and len(result.deep) == 1


@pytest.mark.parametrize(
    ("changes", "stay"),
    [
        ({"timeline": {"kind": "budget", "max_time_error_px": 0.2}}, False),  # a timeline that looks at the frames
        ({"readout": {"latency": {"dark_us": 500}}}, False),  # as slow as pixels are bright
        ({"labels": {"events": True}}, False),
        ({"render": {"antialiasing": "ssaa2"}, "timeline": {"kind": "uniform", "fps": 100}}, True),
    ],
)
def test_who_looks_at_frames_gets_arrays(gl, tmp_path, changes, stay):
    from blinkgl.events import Events
    from blinkgl.sequence import simulate_sequence

    found = []
    for device in ("cpu", "gl"):
        with simulate_sequence(config_of(tmp_path, **{**changes, "events": {"device": device}}), 0, gl) as sequence:
            if device == "gl":
                camera, seen = sequence.camera, []
                step = camera.step
                camera.step = lambda frame, step=step, seen=seen: seen.append(frame.luminance) or step(frame)
            found.append(Events.concatenate([chunk.events for chunk in sequence.chunks()]))
    assert_same(*found)
    assert len(found[0]) > 100 and len(seen) > 3
    assert all(hasattr(frame, "glo") == stay for frame in seen)


def test_what_the_card_does_not_do_names_the_key(gl, tmp_path):
    with pytest.raises(ConfigError, match=r"timeline\.reconstruction: the card follows .*events\.device: auto or cpu"):
        config_of(
            tmp_path, events={"device": "gl"}, timeline={"kind": "uniform", "fps": 200, "reconstruction": "pchip"}
        )
    with pytest.raises(ConfigError, match=r"events\.device"):
        config_of(tmp_path, events={"emulator": "voltmeter", "device": "gl"})
    with pytest.raises(EventDataError, match=r"^events\.threshold_jitter: "):
        made(gl, device="gl", threshold_jitter=4.0)
    with pytest.raises(BlinkGLError, match=r"device.*'auto', 'cpu' or 'gl'"):
        blinkgl.Esim(8, 8, device="cuda")
    assert blinkgl.Esim(8, 8, device="auto").device == "cpu"
