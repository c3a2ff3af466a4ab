"""A sequence directory appears whole or not at all."""

from __future__ import annotations

import signal
import subprocess
import sys

import cv2
import h5py
import numpy as np
import pytest

from blinkgl import srgb
from blinkgl.config.sequence import LabelsConfig
from blinkgl.errors import BlinkGLError, OutputError
from blinkgl.io import flo, images
from blinkgl.io.atomic import atomic_file, remove_stale
from blinkgl.labels import Flow
from blinkgl.sequence_files.sequence_dir import SequenceWriter, read_manifest, verify_sequence
from tests.io.some_events import some_events

H, W = 24, 32


def fill(writer: SequenceWriter, labels: int = 3, reuse: bool = True) -> None:
    buffer = np.empty((H, W, 3), np.float32)  # as a renderer reuses its read-back buffer
    for i in range(labels):
        rng = np.random.default_rng(i)
        t = 100_000 * i
        writer.append_events(some_events(5000, t, t + 100_000, H, W, i))
        buffer[:] = rng.random((H, W, 3))
        writer.label("images", i, buffer, t)
        flow = rng.normal(size=(H, W, 2)).astype(np.float32)
        flow[0, 0] = 300
        valid = np.ones((H, W), bool)
        writer.label("flow_forward", i, Flow(flow, valid), t, t + 100_000)
        writer.label("flow_backward", i, Flow(-flow, valid), t + 100_000, t)
        writer.label("occlusion_forward", i, flow[..., 0] > 0, t)
        writer.label("depth", i, np.full((H, W), i + 1.0, np.float32), t)
        writer.label("velocity", i, flow * 10, t)
        writer.label("normals", i, buffer, t)
        writer.label("ids", i, np.full((H, W), i), t)
    writer.poses(T_world_cam=np.eye(4)[None], times_ns=np.arange(3))
    writer.info["seed"] = np.int64(0)
    writer.t_end_us = 100_000 * labels


def make(final, **kw) -> None:
    with SequenceWriter(final, H, W, config_yaml="seed: 0\n", **kw) as writer:
        fill(writer)


def test_contents_read_back_independently(tmp_path):
    make(tmp_path / "a" / "b", labels=LabelsConfig(float_flow=("npy", "flo"), flow=("forward", "backward")))
    seq = tmp_path / "a" / "b"
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["b"]
    assert (seq / "images/timestamps.txt").read_text() == "0\n100000\n200000\n"
    stamps = np.loadtxt(seq / "flow/forward_timestamps.txt", delimiter=",", comments="#", dtype=np.int64)
    assert stamps.tolist() == [[0, 100000], [100000, 200000], [200000, 300000]]
    assert (
        (seq / "flow/backward_timestamps.txt")
        .read_text()
        .startswith("# from_timestamp_us, to_timestamp_us\n100000, 0\n")
    )
    rng = np.random.default_rng(1)
    image, flow = rng.random((H, W, 3)).astype(np.float32), rng.normal(size=(H, W, 2)).astype(np.float32)
    assert np.array_equal(cv2.imread(str(seq / "images/000001.png"))[..., ::-1], srgb.to_srgb8(image))
    rgb = cv2.imread(str(seq / "flow/forward/000001.png"), cv2.IMREAD_UNCHANGED)[..., ::-1].astype(float)
    assert not rgb[0, 0, 2] and rgb[1:, :, 2].all()
    assert np.abs((rgb[1:, :, :2] - 2**15) / 128 - flow[1:]).max() <= 0.5 / 128
    full = np.load(seq / "flow/forward_npy/000001.npy")
    assert (
        full.shape == (H, W, 3) and full[0, 0].tolist() == [300, 300, 1] and np.array_equal(full[1:, :, :2], flow[1:])
    )
    assert np.array_equal(flo.read_flo(seq / "flow/forward_flo/000001.flo")[0][1:], flow[1:])
    with h5py.File(seq / "events.h5") as file:
        assert len(file["events/t"]) == 15_000 and len(file["ms_to_idx"]) == 301
    with np.load(seq / "poses.npz", allow_pickle=False) as poses:
        assert poses["T_world_cam"].shape == (1, 4, 4)
    manifest = read_manifest(seq)
    assert manifest["events"] == 15_000 and manifest["seed"] == 0
    assert manifest["flow_pixels_out_of_range"] == {"forward": 3, "backward": 3}
    assert verify_sequence(seq) == []


@pytest.mark.parametrize("error", [ValueError("bug"), KeyboardInterrupt(), SystemExit(1)])
def test_nothing_is_left_after_an_exception(tmp_path, error):
    with pytest.raises(type(error)), SequenceWriter(tmp_path / "a", H, W, config_yaml="") as writer:
        fill(writer)
        raise error
    assert list(tmp_path.iterdir()) == []


def test_errors_of_the_background_threads_surface(tmp_path, monkeypatch):
    def full(image):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(images, "encode_image", full)
    with pytest.raises((OutputError, OSError), match="[Nn]o space left"):
        make(tmp_path / "a")
    assert list(tmp_path.iterdir()) == []


def test_kill_leaves_no_final_name_and_the_next_run_cleans_up(tmp_path):
    code = f"""
import time, numpy as np
from blinkgl.sequence_files.sequence_dir import SequenceWriter
with SequenceWriter({str(tmp_path / "a")!r}, 24, 32, config_yaml='') as w:
    w.label('depth', 0, np.zeros((24, 32)), 0)
    print('ready', flush=True)
    time.sleep(60)
"""
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "ready\n"
    leftovers = list(tmp_path.iterdir())
    assert len(leftovers) == 1 and leftovers[0].name.startswith(".a.blinkgl-tmp-")
    assert remove_stale(tmp_path) == []  # its writer lives
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    assert list(tmp_path.iterdir()) == leftovers
    make(tmp_path / "b")
    assert [p.name for p in tmp_path.iterdir()] == ["b"]


def test_atomic_file(tmp_path):
    with atomic_file(tmp_path / "d" / "a.txt") as path:
        assert path.suffix == ".txt"
        path.write_text("one")
        assert not (tmp_path / "d" / "a.txt").exists()
    with pytest.raises(ZeroDivisionError), atomic_file(tmp_path / "d" / "a.txt") as path:
        path.write_text("two")
        raise ZeroDivisionError
    assert (tmp_path / "d" / "a.txt").read_text() == "one" and len(list((tmp_path / "d").iterdir())) == 1
    with pytest.raises(OutputError, match="output file exists"):
        with atomic_file(tmp_path / "d" / "a.txt", overwrite=False):
            pass
    with pytest.raises(BlinkGLError, match="is a folder"), atomic_file(tmp_path / "d"):
        pass
