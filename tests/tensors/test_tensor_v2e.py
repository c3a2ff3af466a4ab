"""TensorV2e makes the events of V2e, bit for bit and in their order, noise included."""

import pytest
import torch

from blinkgl.config.events import V2eConfig
from blinkgl.errors import EventDataError
from blinkgl.events.v2e import V2e
from blinkgl.tensors import TensorV2e
from same_events import compare

_CLEAN = {"cutoff_hz": 0, "leak_rate_hz": 0, "shot_noise_rate_hz": 0, "refractory_us": 0, "leak_jitter": 0}
_NOISY = {"causes": True, "shot_noise_rate_hz": 20.0, "leak_rate_hz": 5.0, "hot_pixel_fraction": 0.05}
OPTIONS = {
    "clean": _CLEAN,
    "low-pass": {**_CLEAN, "cutoff_hz": 200},
    "dead time": {**_CLEAN, "refractory_us": 500},
    "leak": {**_CLEAN, "leak_rate_hz": 50},
    "leak, jitter, dead time": {"shot_noise_rate_hz": 0, "leak_jitter": 0.3, "leak_rate_hz": 50},
    "shot noise": {**_CLEAN, "shot_noise_rate_hz": 50},
    "photoreceptor noise": {**_CLEAN, "cutoff_hz": 100, "photoreceptor_noise": True, "shot_noise_rate_hz": 20},
    "defaults": {},
    "noise, causes": _NOISY,
    "all of photoreceptor noise": {**_NOISY, "photoreceptor_noise": True, "start": "balanced"},
    "long dead time, noise, hot pixels": {**_NOISY, "refractory_us": 20_000},
    "thresholds apart": {"contrast_threshold_off": 0.3, "threshold_sigma": 0},
    "v2e's noisy": {"preset": "noisy", "causes": True, "start": "zero"},
}


@pytest.mark.parametrize("name", OPTIONS)
def test_the_same_events_as_the_numba_kernel(name):
    config = V2eConfig(**OPTIONS[name])
    sizes = ((1, 1, 2), (7, 201, 3), (33, 64, 2))
    assert sum(compare(TensorV2e, V2e, config, *size) for size in sizes) > 2000


def test_more_shot_noise_than_it_may_draw_is_refused():
    emulator = TensorV2e(40, 64, V2eConfig(shot_noise_rate_hz=1e4, max_events_per_step=1000), envs=2)
    emulator.step(torch.full((2, 40, 64), 0.5), 0)
    with pytest.raises(EventDataError, match="environment 1, frame 1.*more shot noise"):
        emulator.step(torch.full((2, 40, 64), 0.5), [1_000, 1_000_000_000])


def test_a_bad_intensity_is_named_and_nothing_changes():
    emulator = TensorV2e(4, 6, V2eConfig(**_NOISY), envs=2)
    emulator.step(torch.full((2, 4, 6), 0.5), 0)
    before, frames = emulator.state_dict(), torch.full((2, 4, 6), 0.9)
    frames[1, 3, 2] = float("nan")
    with pytest.raises(EventDataError, match=r"environment 1, frame 1.*x=2, y=3"):
        emulator.step(frames, 10**9)
    after = emulator.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before)
