"""A sequence directory appears whole or not at all."""

from __future__ import annotations

import signal
import subprocess
import sys

import numpy as np
import pytest

from blinkgl.errors import BlinkGLError, OutputError
from blinkgl.io import images
from blinkgl.io.atomic import atomic_file, remove_stale
from blinkgl.labels import Flow
from blinkgl.sequence_files.sequence_dir import SequenceWriter
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
    writer.arrays("poses.npz", T_world_cam=np.eye(4)[None], times_ns=np.arange(3))
    writer.info["seed"] = np.int64(0)
    writer.t_end_us = 100_000 * labels


def make(final, **kw) -> None:
    with SequenceWriter(final, H, W, config_yaml="seed: 0\n", **kw) as writer:
        fill(writer)


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
