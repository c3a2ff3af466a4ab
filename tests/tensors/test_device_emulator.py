"""``events.device: cuda``: who makes the events, what is refused, and that files are the same. Without a card, torch's
processor stands for it."""

from __future__ import annotations

import hashlib
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

torch = pytest.importorskip("torch")

import blinkgl  # noqa: E402
from blinkgl.config.events import EsimConfig, V2eConfig, VoltmeterConfig  # noqa: E402
from blinkgl.config.run import load_run  # noqa: E402
from blinkgl.dataset.generate import generate_sequence  # noqa: E402
from blinkgl.dataset.verify import verify_dataset  # noqa: E402
from blinkgl.errors import ConfigError, EventDataError  # noqa: E402
from blinkgl.events import Esim  # noqa: E402
from blinkgl.events.v2e import V2e  # noqa: E402
from blinkgl.sequence_files.sequence_dir import read_manifest  # noqa: E402
from blinkgl.tensors import emulator as devices  # noqa: E402
from blinkgl.tensors.choice import make_on_device  # noqa: E402
from blinkgl.tools.same_events import assert_same  # noqa: E402
from tests.tiny_recipe import TINY  # noqa: E402

CARD, SOFTWARE = SimpleNamespace(is_software=False), SimpleNamespace(is_software=True)


@pytest.fixture
def card(monkeypatch):
    monkeypatch.setattr(devices, "DEVICE", "cpu")


def made(gl, config=EsimConfig, **values):
    return make_on_device(config(**values), 16, 24, 1, gl).device


def test_auto_takes_a_card_that_can_do_it(card, monkeypatch):
    assert made(SOFTWARE) == "cpu" == made(None) == made(CARD, device="cpu")
    assert made(CARD) == "cuda" == made(None, device="cuda") == made(CARD, config=V2eConfig)
    assert made(CARD, config=VoltmeterConfig) == "cpu"
    monkeypatch.setattr(devices, "_trials", {})
    monkeypatch.setattr(devices, "same_events", lambda *_: False)
    assert made(CARD) == "cpu"
    with pytest.raises(EventDataError, match=r"^events\.device: the GPU's events of a trial"):
        made(CARD, device="cuda")


def test_what_is_refused(card, tmp_path):
    with pytest.raises(ConfigError, match=r"device.*'gl'.*cuda"):
        blinkgl.Esim(4, 4, device="gl")


def test_a_step_that_the_processor_would_cut_is_refused(card):
    """Else files of a card would hold events that those of the processor do not."""
    config = V2eConfig(preset="clean", device="cuda", contrast_threshold=0.01, max_events_per_step=1000)
    on_card, frames = make_on_device(config, 16, 24, 1), [np.full((16, 24), v, np.float32) for v in (0.1, 0.9)]
    on_card.step(frames[0], 0)
    with pytest.raises(EventDataError, match=r"events\.max_events_per_step.*a higher limit, or events\.device: cpu"):
        on_card.step(frames[1], 10**6)
    kernel = make_on_device(config.model_copy(update={"device": "cpu"}), 16, 24, 1)
    kernel.step(frames[0], 0)
    kernel.step(frames[1], 10**6)
    assert kernel.saturated > 0


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a card")
def test_without_a_card_it_is_said():
    assert made(CARD) == "cpu"
    with pytest.raises(EventDataError, match=r"^events\.device: torch finds no CUDA GPU.*cpu, or auto"):
        made(None, device="cuda")


@pytest.mark.parametrize(
    ("kind", "config"),
    [
        (Esim, EsimConfig(threshold_jitter=0.03, refractory_us=200)),
        (V2e, V2eConfig(leak_rate_hz=5, shot_noise_rate_hz=20, causes=True)),
        (V2e, V2eConfig(preset="noisy", photoreceptor_noise=True)),
    ],
    ids=["esim", "v2e", "v2e, noise"],
)
def test_a_state_goes_on_with_the_other_device(card, kind, config):
    rng = np.random.default_rng(0)
    clip = np.exp(rng.normal(-1, 0.6, (8, 16, 24))).astype(np.float32)
    theirs, ours = kind(16, 24, config, 1), devices.KINDS[kind](16, 24, config, 1, "cpu")
    for k, frame in enumerate(clip):
        if k == 4:
            states = ours.state_dict(), theirs.state_dict()
            assert states[0].keys() == states[1].keys()
            assert all(np.array_equal(states[0][name], states[1][name]) for name in states[1])
            theirs, ours = kind(16, 24, config, 1), devices.KINDS[kind](16, 24, config, 1, "cpu")
            ours.load_state_dict(states[1])
            theirs.load_state_dict(states[0])
        given = torch.from_numpy(frame) if k % 2 else frame
        assert_same(ours.step(given, 1_000_000 * k), theirs.step(frame, 1_000_000 * k), k)
    codes = (clip[0] * 200).clip(0, 255).astype(np.uint8)
    assert_same(ours.step(codes, 10**7), theirs.step(codes, 10**7), "codes")


def test_a_bad_frame_is_said_in_the_same_words(card):
    both = Esim(4, 6), devices.DeviceEsim(4, 6, device="cpu")
    said = []
    for one in both:
        one.step(np.full((4, 6), 0.5, np.float32), 0)
        bad = np.full((4, 6), 0.5, np.float32)
        bad[1, 2] = np.inf
        with pytest.raises(EventDataError) as raised:
            one.step(bad if one is both[0] else torch.from_numpy(bad), 1000)
        said.append((str(raised.value), raised.value.pixel))
        assert len(one.step(np.ones((4, 6), np.float32), 1000)) > 0
    assert said[0] == said[1]


@pytest.mark.parametrize("events", [{}, {"emulator": "v2e", "preset": "noisy", "causes": True}], ids=["esim", "v2e"])
def test_files_are_the_same_and_the_manifest_says_which(card, gl, tmp_path, monkeypatch, events):
    from blinkgl.render.frames import Frame

    tensors, tensor = [], Frame.tensor
    monkeypatch.setattr(Frame, "tensor", lambda frame, *given: tensors.append(frame) or tensor(frame, *given))
    sums, said = {}, {}
    for device in ("cpu", "cuda"):
        recipe = tmp_path / f"{device}.yaml"
        recipe.write_text(yaml.safe_dump({**TINY, "events": {**events, "device": device}}))
        path = generate_sequence(load_run(recipe).sequence(0), 0, tmp_path / device, gl).path
        said[device] = read_manifest(path)["events_device"]
        files = (p for p in path.rglob("*") if p.is_file() and p.name not in ("manifest.json", "config.yaml"))
        sums[device] = {p.relative_to(path).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}
    assert said == {"cpu": "cpu", "cuda": "cuda"} and tensors
    assert sums["cpu"] == sums["cuda"] and "events.h5" in sums["cpu"]
    if not events:
        result = verify_dataset(tmp_path / "cuda", deep=1)
        assert result.clean and len(result.deep) == 1
