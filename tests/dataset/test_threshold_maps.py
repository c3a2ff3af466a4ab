"""Measured thresholds of the pixels from a file: counts by the definition of a threshold, both kinds of emulators, a
file that changes, bad files."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from blinkgl.cli import run
from blinkgl.config.events import EsimConfig, V2eConfig
from blinkgl.events import Esim, V2e
from runs import generated

H, W = 6, 8
CONFIG = f"""
camera: {{width: {W}, height: {H}}}
time: {{duration: 0.05, label_rate: 20}}
events: {{emulator: esim, threshold_map: maps/t.npy}}
labels: {{flow: [], occlusion: false}}
preview: {{enabled: false}}
scene: {{kind: random, pool: {{primitives: [cuboid]}}, textures: {{photographs: false, max_size: 32}}}}
"""


def measured(folder: Path, shape: tuple[int, ...] = (2, H, W), seed: int = 0) -> Path:
    file = folder / "t.npy"
    folder.mkdir(exist_ok=True)
    np.save(file, np.random.default_rng(seed).uniform(0.08, 0.6, shape).astype(np.float32))
    return file


@pytest.mark.parametrize("shape", [(H, W), (2, H, W)])
@pytest.mark.parametrize(("emulator", "kind"), [(Esim, EsimConfig), (V2e, V2eConfig)])
def test_a_pixel_fires_once_for_each_of_its_own_thresholds(emulator, kind, shape, tmp_path):
    """Light that rises by a factor of nine passes floor(ln 9 / C+) levels; what falls afterwards counts from the last
    of those. The thresholds of the configuration play no part."""
    file = measured(tmp_path, shape)
    quiet = {"preset": "clean", "start": "zero", "threshold_sigma": 0.02} if kind is V2eConfig else {"log_eps": 1e-9}
    pixels = emulator(H, W, kind(threshold_map=str(file), **quiet), seed=3)
    _, risen, fallen = (
        pixels.step(np.full((H, W), light, np.float32), k * 10**7) for k, light in enumerate((0.1, 0.9, 0.092))
    )
    on, off = np.broadcast_to(np.load(file).astype(np.float64), (2, H, W))
    ups = np.log(9.0) / on
    downs = (np.floor(ups) * on + np.log(0.1 / 0.092)) / off
    # Within a rounding of a level either count is right.
    sure = np.abs(ups - np.round(ups)) > 1e-3
    for events, levels, polarity in ((risen, ups, 1), (fallen, downs, 0)):
        counted = np.zeros((H, W))
        np.add.at(counted, (events.y, events.x), 1)
        sure &= np.abs(levels - np.round(levels)) > 1e-3
        assert (events.p == polarity).all() and np.array_equal(counted[sure], np.floor(levels)[sure])
    assert sure.mean() > 0.9


@pytest.mark.parametrize(("emulator", "kind"), [(Esim, EsimConfig), (V2e, V2eConfig)])
def test_tensors_have_the_same_thresholds(emulator, kind, tmp_path):
    pytest.importorskip("torch")
    from blinkgl.tensors import TensorEsim, TensorV2e
    from blinkgl.tools.same_events import compare

    file = measured(tmp_path, (40, 64))
    of_tensors = TensorEsim if kind is EsimConfig else TensorV2e
    assert compare(of_tensors, emulator, kind(threshold_map=str(file)), 40, 64, 2) > 1000


def test_a_file_that_changed_ends_resume_with_its_name(tmp_path, capsys):
    """A path is relative to the recipe, wherever the command is run; the contents belong to the run."""
    measured(tmp_path / "maps")
    generated(tmp_path, CONFIG)
    measured(tmp_path / "maps", seed=1)
    capsys.readouterr()
    assert run(["generate", str(tmp_path / "run.yaml"), "--out", str(tmp_path / "out"), "--resume"]) == 2
    line = capsys.readouterr().err
    assert "have changed since the run began: maps/t.npy (changed)" in line and line.count("\n") == 1


BAD = {
    "another size": (np.full((H, W + 1), 0.2), f"got 'float64 ({H}, {W + 1})'); expected floats of shape ({H}, {W}),"),
    "whole numbers": (np.full((H, W), 1), f"got 'int64 ({H}, {W})'); expected floats of shape"),
    "negative": (np.full((H, W), -0.2), f"{H * W} thresholds out of range, the first at pixel (0, 0) (got -0.2)"),
    "no number": (np.where(np.eye(H, W)[::-1], np.nan, 0.2), f"{H} thresholds out of range, the first at pixel (5, 0)"),
    "missing": (None, "events.threshold_map: no such file (got 'maps/t.npy'); expected a .npy file of thresholds"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_end_in_a_line_before_anything_is_drawn(name, tmp_path, capsys):
    values, message = BAD[name]
    (tmp_path / "maps").mkdir()
    if values is not None:
        np.save(tmp_path / "maps/t.npy", values)
    (tmp_path / "config.yaml").write_text(CONFIG)
    assert run(["generate", str(tmp_path / "config.yaml"), "--out", str(tmp_path / "out")]) == 2
    line = capsys.readouterr().err
    assert message in line and "events.threshold_map" in line and line.count("\n") == 1
    assert not list((tmp_path / "out").rglob("manifest.json"))


def test_the_voltmeter_says_who_has_the_key(tmp_path, capsys):
    tree = yaml.safe_load(CONFIG)
    tree["events"]["emulator"] = "voltmeter"
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(tree))
    assert run(["generate", str(tmp_path / "config.yaml"), "--out", str(tmp_path / "out")]) == 2
    assert "it is a key of emulator: esim; it is a key of emulator: v2e" in capsys.readouterr().err
