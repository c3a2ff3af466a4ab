"""TensorEsim makes the events of Esim, bit for bit and in their order."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

import blinkgl  # noqa: E402
from blinkgl.config.events import EsimConfig, V2eConfig  # noqa: E402
from blinkgl.errors import EventDataError  # noqa: E402
from blinkgl.events.esim import Esim  # noqa: E402
from blinkgl.events.v2e import V2e  # noqa: E402
from blinkgl.tensors import TensorEsim, TensorV2e, batch  # noqa: E402
from blinkgl.tools.same_events import assert_same, compare  # noqa: E402

OPTIONS = {
    "defaults": {},
    "one threshold": {"threshold_sigma": 0},
    "two thresholds": {"threshold_sigma": 0, "contrast_threshold_off": 0.3},
    "spread, causes": {"threshold_sigma": 0.1, "causes": True},
    "refractory": {"refractory_us": 700},
    "jitter": {"threshold_jitter": 0.05},
    "jitter, refractory": {"threshold_jitter": 0.05, "refractory_us": 300, "threshold_sigma": 0},
    "cut": {"contrast_threshold": 0.02, "max_events_per_step": 1000},
    "cut, refractory": {"contrast_threshold": 0.02, "max_events_per_step": 1000, "refractory_us": 100},
    "cut, jitter": {"contrast_threshold": 0.02, "max_events_per_step": 1000, "threshold_jitter": 0.01},
}
SIZES = ((1, 1, 2), (3, 5, 1), (7, 201, 3), (40, 64, 2))


@pytest.mark.parametrize("name", OPTIONS)
def test_the_same_events_as_the_numba_kernel(name):
    assert sum(compare(TensorEsim, Esim, EsimConfig(**OPTIONS[name]), *size) for size in SIZES) > 20_000


def test_frames_larger_than_a_chunk(monkeypatch):
    monkeypatch.setitem(batch._CHUNK, "cpu", 1000)
    assert compare(TensorEsim, Esim, EsimConfig(), 37, 61, 3) > 1000


def test_the_same_events_where_the_host_looks_once(monkeypatch):
    """The way of a card, which counts every pixel so that one transfer will do."""
    monkeypatch.setattr(TensorEsim, "_host_is_near", False)
    for name in ("defaults", "two thresholds", "refractory", "jitter", "cut"):
        assert compare(TensorEsim, Esim, EsimConfig(**OPTIONS[name]), 7, 201, 3) > 1000


def test_emulators_of_a_batch_know_nothing_of_each_other():
    """Environment k is a batch of one with its seed."""
    rng, config = np.random.default_rng(1), EsimConfig(threshold_jitter=0.02)
    together = blinkgl.TensorEsim(9, 11, config, envs=3, seed=2**64 - 1)
    alone = [blinkgl.TensorEsim(9, 11, config, seed=s) for s in (2**64 - 1, 0, 1)]
    for n in range(4):
        frames = torch.from_numpy(np.exp(rng.normal(-1, 1, (3, 9, 11))).astype(np.float32))
        chunks = together.step(frames, 1_000_000 * n).numpy()
        for k, one in enumerate(alone):
            assert_same(chunks[k], one.step(frames[k : k + 1], 1_000_000 * n).numpy()[0], (n, k))


def steps(emulator, frames, t_ns):
    return list(emulator.step(frames, t_ns).numpy())


def good(envs=3, value=0.5):
    return torch.full((envs, 4, 6), value)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1.0, 2.0**31])
def test_a_bad_intensity_is_named_and_nothing_changes(value):
    emulator, beside = (TensorEsim(4, 6, envs=3, seed=3) for _ in range(2))
    for one in (emulator, beside):
        one.step(good(), [0, 10, 20])
    frames = good(value=0.9)
    frames[1, 2, 5] = value
    frames[2, 0, 0] = value
    with pytest.raises(EventDataError, match=r"environment 1, frame 1.*x=5, y=2") as raised:
        emulator.step(frames, [1000, 1000, 1000])
    assert raised.value.pixel == (5, 2)
    before, after = emulator.state_dict(), beside.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in after)
    for ours, theirs in zip(steps(emulator, good(value=0.9), 1000), steps(beside, good(value=0.9), 1000)):
        assert len(ours) > 0
        assert_same(ours, theirs, value)


@pytest.mark.parametrize(
    ("frames", "t_ns", "says"),
    [
        (good(2), 1000, r"frames.*\(3, 4, 6\)"),
        (good()[:, :3], 1000, r"frames.*\(3, 4, 6\)"),
        (good().double(), 1000, "float32"),
        (good().numpy(), 1000, "frames"),
        (good().to("meta"), 1000, "another device"),
        (good(), [1000, 10, 1000], "environment 1, frame 1.*increase"),
        (good(), [1000, 1000, 10**13], "environment 2, frame 1.*17 minutes"),
        (good(), [1000, 1000], "t_ns"),
        (good(), 0.5, "t_ns"),
        (good(), 2**70, "t_ns"),
    ],
)
def test_bad_input_is_refused(frames, t_ns, says):
    emulator = TensorEsim(4, 6, envs=3)
    emulator.step(good(), [0, 10, 20])
    before = emulator.state_dict()
    with pytest.raises(EventDataError, match=says):
        emulator.step(frames, t_ns)
    after = emulator.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in after)
    assert len(emulator.step(good(value=0.9), 1000)) > 0


def test_what_does_not_fit_is_refused():
    for arguments in (
        {"height": 0, "width": 4},
        {"height": 4, "width": 4, "envs": 0},
        {"height": 2**15, "width": 2**15, "envs": 2},
    ):
        with pytest.raises(EventDataError, match="out of range"):
            TensorEsim(**arguments)
    emulator = TensorEsim(4, 6, envs=3)
    with pytest.raises(EventDataError, match="mask"):
        emulator.reset(torch.ones(2, dtype=torch.bool))
    with pytest.raises(EventDataError, match="other emulators"):
        emulator.load_state_dict(TensorEsim(4, 6, envs=2).state_dict())


# --- TensorV2e makes the events of V2e, bit for bit and in their order, noise included.

_CLEAN = {"cutoff_hz": 0, "leak_rate_hz": 0, "shot_noise_rate_hz": 0, "refractory_us": 0, "leak_jitter": 0}
_NOISY = {"causes": True, "shot_noise_rate_hz": 20.0, "leak_rate_hz": 5.0, "hot_pixel_fraction": 0.05}
OPTIONS_TENSOR_V2E = {
    "clean": _CLEAN,
    "low-pass": {**_CLEAN, "cutoff_hz": 200},
    "dead time": {**_CLEAN, "refractory_us": 500},
    "leak": {**_CLEAN, "leak_rate_hz": 50},
    "leak, jitter, dead time": {"shot_noise_rate_hz": 0, "leak_jitter": 0.3, "leak_rate_hz": 50},
    "shot noise": {**_CLEAN, "shot_noise_rate_hz": 50},
    "hardly any shot noise": {**_CLEAN, "shot_noise_rate_hz": 0.9},
    "photoreceptor noise": {**_CLEAN, "cutoff_hz": 100, "photoreceptor_noise": True, "shot_noise_rate_hz": 20},
    "defaults": {},
    "noise, causes": _NOISY,
    "all of photoreceptor noise": {**_NOISY, "photoreceptor_noise": True, "start": "balanced"},
    "long dead time, noise, hot pixels": {**_NOISY, "refractory_us": 20_000},
    "thresholds apart": {"contrast_threshold_off": 0.3, "threshold_sigma": 0},
    "v2e's noisy": {"preset": "noisy", "causes": True, "start": "zero"},
}


@pytest.mark.parametrize("name", OPTIONS_TENSOR_V2E)
def test_the_same_events_as_the_numba_kernel_of_tensor_v2e(name):
    config = V2eConfig(**OPTIONS_TENSOR_V2E[name])
    sizes = ((1, 1, 2), (7, 201, 3), (33, 64, 2))
    assert sum(compare(TensorV2e, V2e, config, *size) for size in sizes) > 2000


def test_more_shot_noise_than_it_may_draw_is_refused():
    emulator = TensorV2e(40, 64, V2eConfig(shot_noise_rate_hz=1e4, max_events_per_step=1000), envs=2)
    emulator.step(torch.full((2, 40, 64), 0.5), 0)
    with pytest.raises(EventDataError, match="environment 1, frame 1.*more shot noise"):
        emulator.step(torch.full((2, 40, 64), 0.5), [1_000, 1_000_000_000])


def test_a_bad_intensity_is_named_and_nothing_changes_of_tensor_v2e():
    emulator = TensorV2e(4, 6, V2eConfig(**_NOISY), envs=2)
    emulator.step(torch.full((2, 4, 6), 0.5), 0)
    before, frames = emulator.state_dict(), torch.full((2, 4, 6), 0.9)
    frames[1, 3, 2] = float("nan")
    with pytest.raises(EventDataError, match=r"environment 1, frame 1.*x=2, y=3"):
        emulator.step(frames, 10**9)
    after = emulator.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before)
